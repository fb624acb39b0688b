//! Prediction horizon: the tissue is solved for the pose at which its contact model will be used.
//!
//! A contact model that takes S to solve is used from S after its sample on. The force loop blends it in over B and the next
//! one, P later, as slowly out, so the middle of its use is S + (P + B) / 2 after the sample: 6 ms with P = B = 4 ms, 20 ms on
//! slow computers. A model of the sampled pose would be linearised that far behind the hand. The pose is predicted at constant
//! velocity; where the hand moves otherwise, the model follows the measured pose, as between any two solves.

use palpate_device::Pose;
use palpate_haptics::BLEND_MAX;
use palpate_protocol::{ClientTime, Span};
use palpate_site::HAPTIC_PERIOD;

use super::Frame;

/// Longest horizon. A hand that accelerates at 5 m/s² is then 1 mm away from the predicted pose.
const HORIZON_MAX: Span = Span::from_millis(20);

/// Weight of the newest model in the mean: one eighth, so that a single late solve changes little.
const NEWEST: i64 = 8;

/// Mean time from a sample to the middle of the use of its contact model.
#[derive(Debug, Clone)]
pub struct Horizon {
    mean: Span,
    /// Times of sample and publication of the last model; `None` if that was not solved.
    last: Option<(ClientTime, ClientTime)>,
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
    /// The time for which a pose sampled at `sampled` is predicted.
    pub fn after(&self, sampled: ClientTime) -> ClientTime {
        sampled + self.mean
    }

    /// Notes that a model of the sample at `sampled` was solved and published; it replaces the last one.
    pub fn note_model(&mut self, sampled: ClientTime, published: ClientTime) {
        if let Some((from, began)) = self.last {
            let period = published - began;
            let blended = period.min(BLEND_MAX);
            let middle_us = (began - from).as_micros() + (period + blended).as_micros() / 2;
            let middle_us = middle_us.clamp(0, HORIZON_MAX.as_micros());
            let change_us = (middle_us - self.mean.as_micros()) / NEWEST;
            self.mean += Span::from_micros(change_us);
        }
        self.last = Some((sampled, published));
    }

    /// Notes that the last model stays in use without a solve.
    pub fn note_pause(&mut self) {
        self.last = None;
    }
}

impl Frame {
    /// The pose at `time`, predicted at constant velocity; the measured one if that is newer.
    pub fn predicted_pose(&self, time: ClientTime) -> Pose {
        let dt = time - self.time;
        self.sample.predicted_pose(dt.as_secs_f64().max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: i64) -> ClientTime {
        ClientTime::from_micros(1000 * ms)
    }

    /// After enough models of a period `period`, each solved in `solve` ms.
    fn settled(solve: i64, period: i64) -> Span {
        let mut horizon = Horizon::default();
        for i in 0..200 {
            horizon.note_model(ms(i * period), ms(i * period + solve));
        }
        horizon.after(ClientTime::ZERO) - ClientTime::ZERO
    }

    #[test]
    fn horizon_is_the_middle_of_the_use() {
        for (solve, period, expected_us) in [(1, 4, 5000), (2, 4, 6000), (6, 12, 17_000)] {
            let us = settled(solve, period).as_micros();
            assert!((us - expected_us).abs() <= NEWEST, "{us} µs for {solve} ms");
        }
        assert!(settled(20, 40) <= HORIZON_MAX);
    }

    #[test]
    fn pauses_do_not_count() {
        let mut horizon = Horizon::default();
        horizon.note_model(ms(0), ms(1));
        let before = horizon.after(ms(0));
        horizon.note_pause();
        horizon.note_model(ms(1000), ms(1001));
        assert_eq!(horizon.after(ms(0)), before);
    }

    #[test]
    fn a_solve_longer_than_the_horizon_uses_the_measured_pose() {
        let mut frame = Frame::before(ms(200));
        frame.sample.velocity.x = 0.3;
        assert_eq!(frame.predicted_pose(ms(190)), frame.sample.pose);
        assert!((frame.predicted_pose(ms(210)).position.x - 0.003).abs() < 1e-12);
    }
}
