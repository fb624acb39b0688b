//! Sampled hand motion and its ground truth.

use nalgebra::{Quaternion, UnitQuaternion};
use palpate_protocol::datagram::as_sent;
use palpate_protocol::timeline::{Method, Timeline};
use palpate_protocol::{Pose, ServerTime, ToolSample};

use crate::chart::{AMBER, BLUE, GREEN, GREY, Line, ORANGE, PURPLE, SKY};
use crate::hand::Hand;

/// Time span of the samples before a gap that a method may use, µs.
pub(super) const HISTORY_US: i64 = 60_000;

/// Methods of a kind. The Kalman filters interpolate as windowed Verlet does.
pub(super) fn methods(interpolation: bool) -> impl Iterator<Item = Method> {
    Method::ALL
        .into_iter()
        .filter(move |method| !(interpolation && *method == Method::Kalman))
}

pub(super) struct Sampled<'a> {
    hand: &'a dyn Hand,
    pub(super) period_us: i64,
    end_us: i64,
}

impl<'a> Sampled<'a> {
    /// Samples a hand motion at `rate_hz`. At most its first hour is used.
    pub(super) fn new(hand: &'a dyn Hand, rate_hz: u32) -> Result<Self, String> {
        let end_us = (hand.length_s().min(3600.0) * 1e6) as i64;
        let sampled = Self {
            hand,
            period_us: 1_000_000 / i64::from(rate_hz),
            end_us,
        };
        sampled.gap_range(HISTORY_US)?;
        Ok(sampled)
    }

    /// The first and last time, µs, with enough history before and `after_us` after.
    pub(super) fn gap_range(&self, after_us: i64) -> Result<(i64, i64), String> {
        let last = self.end_us - after_us - HISTORY_US;
        if last < 2 * HISTORY_US {
            return Err(format!(
                "the motion lasts {:.3} s; samples before and after a gap need {:.3} s",
                self.end_us as f64 * 1e-6,
                (after_us + 3 * HISTORY_US) as f64 * 1e-6
            ));
        }
        Ok((2 * HISTORY_US, last))
    }

    pub(super) fn true_pose(&self, t_us: i64) -> Pose {
        self.hand.at(t_us as f64 * 1e-6)
    }

    /// The samples of a closed time interval, quantised as on the wire. A pose outside the valid range is an
    /// error.
    pub(super) fn samples(&self, from_us: i64, until_us: i64) -> Result<Vec<ToolSample>, String> {
        // Counted back from the end, so the last sample is at `until_us` exactly.
        let n = (until_us - from_us) / self.period_us;
        let sample = |k: i64| {
            let t_us = until_us - k * self.period_us;
            let sample = ToolSample {
                time: ServerTime::from_micros(t_us),
                pose: self.true_pose(t_us),
                ..ToolSample::default()
            };
            as_sent(&sample).map_err(|e| {
                format!(
                    "the motion at {:.3} s cannot be encoded: {e}",
                    t_us as f64 * 1e-6
                )
            })
        };
        (0..=n).rev().map(sample).collect()
    }

    /// Inserts these samples into a timeline.
    pub(super) fn fill(
        &self,
        timeline: &mut Timeline,
        from_us: i64,
        until_us: i64,
    ) -> Result<(), String> {
        for sample in self.samples(from_us, until_us)? {
            timeline.insert(sample);
        }
        Ok(())
    }
}

/// A method's line. Lines for comparison are dashed and drawn on top.
pub(super) fn method_line(method: Method, points: impl IntoIterator<Item = (f64, f64)>) -> Line {
    let (colour, dashed) = match method {
        Method::Hold => (GREY, true),
        Method::Linear => (GREEN, false),
        Method::VerletRaw => (ORANGE, true),
        Method::Verlet => (BLUE, false),
        Method::Hermite => (PURPLE, false),
        Method::Kalman => (SKY, false),
        Method::Chosen => (AMBER, false),
    };
    Line::new(method.name(), colour, points).dashed(dashed)
}

pub(super) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>()).sqrt()
}

/// Angle between two orientations (x, y, z, w) on SO(3), degrees.
pub(super) fn angle_deg(a: [f64; 4], b: [f64; 4]) -> f64 {
    let unit = |[x, y, z, w]: [f64; 4]| UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z));
    unit(a).angle_to(&unit(b)).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::angle_deg;

    #[test]
    fn quaternion_and_its_negative_are_one_rotation() {
        let quarter = [0.0, 0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()];
        assert!(angle_deg(quarter, quarter.map(|c| -c)) < 1e-6);
        assert!((angle_deg([0.0, 0.0, 0.0, 1.0], quarter) - 90.0).abs() < 1e-9);
    }
}
