//! Prediction horizon: the tissue is solved for the pose at which its contact model will be used.
//!
//! The force loop blends a contact model in over the period P that follows its publication, and out over the next one. If the
//! model is published S after its sample, the middle of its use is S + P after the sample: 6 ms if solves take 2 ms of 4,
//! 20 ms on slow computers. A model of the sampled pose would be linear around a pose that far behind the hand.
//!
//! The pose is predicted at constant velocity. Where the hand moves otherwise, the model follows the measured pose along its
//! normals, as between any two solves, within the stiffness cap.

use palpate_device::{Pose, Sample};
use palpate_protocol::{ClientTime, Span};
use palpate_site::{HAPTIC_PERIOD, HandPose};

use super::Frame;

/// Longest horizon. A hand that accelerates at 5 m/s² is then 1 mm away from the predicted pose.
const HORIZON_MAX: Span = Span::from_millis(20);

/// Models over which the horizon is averaged, so that a single late solve changes little.
const MODELS: i64 = 8;

/// Mean time from a sample to the middle of the use of its contact model.
#[derive(Debug, Clone)]
pub struct Horizon {
    mean: Span,
    /// Time of the sample of the last model; `None` if that was not solved.
    last: Option<ClientTime>,
}

/// The horizon of solves that take no time.
impl Default for Horizon {
    fn default() -> Self {
        Self {
            mean: HAPTIC_PERIOD,
            last: None,
        }
    }
}

impl Horizon {
    /// The pose of a hand at a frame and at the horizon.
    pub fn hand_pose(&self, frame: &Frame) -> HandPose {
        HandPose {
            measured: frame.sample.pose,
            predicted: self.predicted_pose(&frame.sample),
        }
    }

    /// The pose at the horizon of a sample.
    pub fn predicted_pose(&self, sample: &Sample) -> Pose {
        sample.predicted_pose(self.mean.as_secs_f64())
    }

    /// Notes that a model of the sample at `sampled` was solved and published; it replaces the last one.
    pub fn note_model(&mut self, sampled: ClientTime, published: ClientTime) {
        if let Some(last) = self.last {
            // The last model is in the middle of its use when the next one is published.
            let middle_us = (published - last).as_micros();
            let change_us = middle_us.clamp(0, HORIZON_MAX.as_micros()) - self.mean.as_micros();
            self.mean += Span::from_micros(change_us / MODELS);
        }
        self.last = Some(sampled);
    }

    /// Notes that the last model stays in use without a solve.
    pub fn note_pause(&mut self) {
        self.last = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: i64) -> ClientTime {
        ClientTime::from_micros(1000 * ms)
    }

    /// The horizon after many models of this period, each published `solve` after its sample, in ms.
    fn settled_ms(solve: i64, period: i64) -> f64 {
        let mut horizon = Horizon::default();
        for i in 0..200 {
            horizon.note_model(ms(i * period), ms(i * period + solve));
        }
        horizon.mean.as_secs_f64() * 1e3
    }

    #[test]
    fn horizon_is_the_middle_of_the_use() {
        for (solve, period) in [(0, 4), (1, 4), (2, 4), (6, 12)] {
            let expected = (solve + period) as f64;
            let off = (settled_ms(solve, period) - expected).abs();
            assert!(off < 0.01, "{off} ms for {solve} of {period} ms");
        }
        assert!(settled_ms(20, 40) <= 20.0);
    }

    #[test]
    fn pauses_do_not_count() {
        let mut horizon = Horizon::default();
        horizon.note_model(ms(0), ms(1));
        let before = horizon.mean;
        horizon.note_pause();
        horizon.note_model(ms(1000), ms(1001));
        assert_eq!(horizon.mean, before);
    }
}
