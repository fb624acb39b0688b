//! A hand's motion as a stream of samples brings it, beside what it truly is.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::datagram::as_sent;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{Pose, ServerTime, ToolSample};

use crate::chart::{BLUE, GREEN, GREY, ORANGE, PURPLE};
use crate::hand::Hand;

/// Samples before a gap that any method may look at, µs.
pub(super) const HISTORY_US: i64 = 60_000;

/// A hand and how often it is sampled.
pub(super) struct Sampled<'a> {
    hand: &'a dyn Hand,
    pub(super) period_us: i64,
    end_us: i64,
}

impl<'a> Sampled<'a> {
    /// A hand that is sampled so often. Only the first hour of it is looked at.
    pub(super) fn new(hand: &'a dyn Hand, rate_hz: u32) -> Result<Self, String> {
        let end_us = (hand.length_s().min(3600.0) * 1e6) as i64;
        let sampled = Self {
            hand,
            period_us: 1_000_000 / i64::from(rate_hz),
            end_us,
        };
        sampled.room(HISTORY_US)?;
        Ok(sampled)
    }

    /// The first and the last moment, µs, at which there is history before and `after_us` beyond.
    pub(super) fn room(&self, after_us: i64) -> Result<(i64, i64), String> {
        let last = self.end_us - after_us - HISTORY_US;
        if last < 2 * HISTORY_US {
            return Err(format!(
                "the motion lasts {:.3} s; {:.3} s are needed for samples before and after a gap",
                self.end_us as f64 * 1e-6,
                (after_us + 3 * HISTORY_US) as f64 * 1e-6
            ));
        }
        Ok((2 * HISTORY_US, last))
    }

    /// Where the hand truly is and how it is turned.
    pub(super) fn truth(&self, t_us: i64) -> Pose {
        self.hand.at(t_us as f64 * 1e-6)
    }

    /// Puts the samples from one moment to another, both included, into a timeline, as the wire rounds them; an error
    /// when the hand goes where no sample may be.
    pub(super) fn fill(
        &self,
        timeline: &mut Timeline,
        from_us: i64,
        until_us: i64,
    ) -> Result<(), String> {
        // Counted back from the end, so that the last one is known to the moment.
        let n = (until_us - from_us) / self.period_us;
        for k in (0..=n).rev() {
            let t_us = until_us - k * self.period_us;
            let sample = ToolSample {
                time: ServerTime::from_micros(t_us),
                pose: self.truth(t_us),
                ..ToolSample::default()
            };
            let sent = as_sent(&sample).map_err(|e| {
                format!(
                    "the motion at {:.3} s can not be sent: {e}",
                    t_us as f64 * 1e-6
                )
            })?;
            timeline.insert(sent);
        }
        Ok(())
    }
}

/// The colour of a method's line in every picture, and whether it is dashed: what is there for comparison is, and lies on
/// top where it is one with another.
pub(super) fn look(method: Method) -> (&'static str, bool) {
    match method {
        Method::Hold => (GREY, true),
        Method::Linear => (GREEN, false),
        Method::VerletRaw => (ORANGE, true),
        Method::Verlet => (BLUE, false),
        Method::Hermite => (PURPLE, false),
    }
}

/// Between two places, m.
pub(super) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>()).sqrt()
}

/// Between two turns as the wire knows them (x, y, z, w), the shortest way on SO(3), degrees.
pub(super) fn angle_deg(a: [f64; 4], b: [f64; 4]) -> f64 {
    let unit = |[x, y, z, w]: [f64; 4]| UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z));
    unit(a).angle_to(&unit(b)).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::angle_deg;

    #[test]
    fn a_quaternion_and_its_negative_are_one_turn() {
        let quarter = [0.0, 0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()];
        assert!(angle_deg(quarter, quarter.map(|c| -c)) < 1e-6);
        assert!((angle_deg([0.0, 0.0, 0.0, 1.0], quarter) - 90.0).abs() < 1e-9);
    }
}
