//! The other reading of artificial time compensation: the server predicts.
//!
//! The source's abstract states that compensation reduces "the time discrepancy between the server and
//! the client", which has two readings (both rules are reconstructed). In delay equalisation every site
//! shows an event stamped t at t + D; sessions use it. In prediction no site delays: the server
//! extrapolates a tool to the arrival time of the packet at each client,
//!
//! ```text
//! sent to client k:   x^(g + A_k)         g the newest sample's moment, A_k the age of such samples at k
//! A_k -> μ_k + 2ν_k   mean age and mean deviation that k reports, slewed by dA/dt in [-0.25, +0.05], A <= 200 ms
//! ```
//!
//! so that the disagreement of two sites is the prediction error over A; under equalisation it is the
//! motion missing beyond D. `palpate-lab run atc-predicted` compares the two: a hand of 87 mm/s and 0.1
//! mm of tremor can be predicted for about ten milliseconds.

use super::{SLEW_DOWN, SLEW_UP};
use crate::request::DelayReport;
use crate::{ServerTime, Span};

/// The largest prediction horizon: by then a hand's tremor has reversed twice.
pub const PREDICTION_MAX: Span = Span::from_millis(200);

/// The number of mean deviations above the mean age. Consecutive predictions differ, so that a client
/// that extrapolates beyond the newest amplifies their differences (54 mm across an ocean at 0
/// deviations); longer predictions are each worse. The sum of both errors is smallest at 1 to 2.
const DEVIATIONS: f64 = 2.0;

/// How far ahead the server predicts for one client. Calling order: [`handle_report`](Self::handle_report) with reports
/// and [`prediction_horizon_at`](Self::prediction_horizon_at) with times that do not go back.
#[derive(Debug, Clone, Copy, Default)]
pub struct Prediction {
    target_us: f64,
    known: Option<(ServerTime, f64)>,
}

impl Prediction {
    /// Nothing reported: nothing is predicted.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a client's report on the age of remote samples on their arrival.
    pub fn handle_report(&mut self, report: DelayReport, now: ServerTime) {
        let most = PREDICTION_MAX.as_micros() as f64;
        let horizon_us = f64::from(report.mean_us) + DEVIATIONS * f64::from(report.deviation_us);
        self.target_us = horizon_us.min(most);
        if self.known.is_none() {
            // Without an earlier prediction the displayed tool can not jump.
            self.known = Some((now, self.target_us));
        }
    }

    /// The prediction horizon beyond a tool's newest sample at a moment: slewed, so that displayed
    /// motion neither reverses nor accelerates, by the rates of the other reading.
    pub fn prediction_horizon_at(&mut self, now: ServerTime) -> Span {
        let Some((at, before_us)) = self.known else {
            return Span::ZERO;
        };
        let elapsed_us = (now - at).as_micros().max(0) as f64;
        let difference_us = self.target_us - before_us;
        let ahead_us =
            before_us + difference_us.clamp(-SLEW_UP * elapsed_us, SLEW_DOWN * elapsed_us);
        self.known = Some((at.max(now), ahead_us));
        Span::from_micros(ahead_us.round() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn report(mean_us: u32) -> DelayReport {
        DelayReport {
            mean_us,
            ..DelayReport::default()
        }
    }

    #[test]
    fn no_prediction_before_the_first_report_which_counts_at_once() {
        let mut prediction = Prediction::new();
        let now = ServerTime::from_micros(7_000_000);
        assert_eq!(prediction.prediction_horizon_at(now), Span::ZERO);
        prediction.handle_report(report(60_000), now);
        assert_eq!(prediction.prediction_horizon_at(now), Span::from_millis(60));
    }

    proptest! {
        #[test]
        fn predicted_time_advances_at_most_five_percent_faster_within_the_limit(
            reports in prop::collection::vec((0_u32..2_000_000, 1_i64..2000), 1..40),
        ) {
            let mut prediction = Prediction::new();
            let mut now = ServerTime::from_micros(1_000_000);
            let mut last: Option<(ServerTime, ServerTime)> = None;
            for (mean_us, lasts_ms) in reports {
                prediction.handle_report(report(mean_us), now);
                for _ in 0..lasts_ms / 4 {
                    let ahead = prediction.prediction_horizon_at(now);
                    prop_assert!(ahead >= Span::ZERO && ahead <= PREDICTION_MAX);
                    let predicted = now + ahead;
                    if let Some((at, before)) = last {
                        let rate = (predicted - before).as_micros() as f64 / (now - at).as_micros() as f64;
                        prop_assert!((1.0 - SLEW_UP - 1e-3..=1.0 + SLEW_DOWN + 1e-3).contains(&rate), "{}", rate);
                    }
                    last = Some((now, predicted));
                    now = now + Span::from_millis(4);
                }
            }
        }
    }
}
