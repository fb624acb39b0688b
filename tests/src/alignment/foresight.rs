//! What a server does that predicts: two tools, each foreseen for the other site.

use palpate_protocol::compensation::{PREDICTION_MAX, Prediction};
use palpate_protocol::request::DelayReport;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{ServerTime, ToolSample};

/// The server's side of prediction.
pub(super) struct Foresight {
    /// The tool of each site as the server knows it.
    tools: [Timeline; 2],
    /// How far ahead each site is to be shown the other's tool.
    ahead: [Prediction; 2],
}

impl Default for Foresight {
    fn default() -> Self {
        let tool = || Timeline::new(Method::default(), PREDICTION_MAX);
        Self {
            tools: [tool(), tool()],
            ahead: [Prediction::new(); 2],
        }
    }
}

impl Foresight {
    /// A site says what it measures.
    pub(super) fn handle_report(&mut self, site: usize, report: DelayReport, now: ServerTime) {
        self.ahead[site].handle_report(report, now);
    }

    /// Samples of a site's tool have come: what the other is sent, and the moment of the sample that it rests on.
    pub(super) fn handle_samples(
        &mut self,
        site: usize,
        samples: &[ToolSample],
        now: ServerTime,
    ) -> Option<(ToolSample, ServerTime)> {
        let tool = &mut self.tools[site];
        for sample in samples {
            tool.insert(*sample);
        }
        let newest = tool.newest()?;
        let time = newest + self.ahead[1 - site].ahead_at(now);
        let sample = ToolSample {
            time,
            pose: tool.foresee(time)?,
            ..*samples.last()?
        };
        Some((sample, newest))
    }
}
