//! Server-side prediction of two tools, each extrapolated for the other site.

use palpate_protocol::compensation::{PREDICTION_MAX, Prediction};
use palpate_protocol::request::DelayReport;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{ServerTime, ToolSample};

pub(super) struct Predictor {
    tools: [Timeline; 2],
    ahead: [Prediction; 2],
}

impl Default for Predictor {
    fn default() -> Self {
        let tool = || Timeline::new(Method::default(), PREDICTION_MAX);
        Self {
            tools: [tool(), tool()],
            ahead: [Prediction::new(); 2],
        }
    }
}

impl Predictor {
    pub(super) fn handle_report(&mut self, site: usize, report: DelayReport, now: ServerTime) {
        self.ahead[site].handle_report(report, now);
    }

    /// Receives samples of a site's tool. Returns the predicted sample for the other site and the time of
    /// the newest real sample.
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
        let time = newest + self.ahead[1 - site].prediction_horizon_at(now);
        let sample = ToolSample {
            time,
            pose: tool.uncorrected_pose(time)?,
            ..*samples.last()?
        };
        Some((sample, newest))
    }
}
