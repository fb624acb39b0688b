//! Hands with a known continuous motion, to compare with the motion after a network.
//!
//! | | motion |
//! | --- | --- |
//! | [`Motion`] | a recorded hand, from a table or a recording of a session |
//! | [`Random`] | band-limited, with tremor, from a seed |
//! | [`Sensor`] | records another hand at its own rate and with noise |

pub(crate) mod command;
mod random;
mod sensor;

use palpate_device::backend::replay::{Moment, Motion};
use palpate_protocol::Pose;

pub use random::{HandParameters, Random};
pub use sensor::Sensor;

pub trait Hand: Send + Sync {
    /// Pose `t_s` seconds after the start of the motion; constant before the start and after the end.
    fn at(&self, t_s: f64) -> Pose;

    /// Length, s; infinite for an endless motion.
    fn length_s(&self) -> f64;

    /// Samples per second of a recording, from the median of their intervals; `None` for a continuous motion.
    fn rate_hz(&self) -> Option<f64> {
        None
    }
}

impl Hand for Motion {
    fn at(&self, t_s: f64) -> Pose {
        // The search begins at the row before that time, so that random access is cheap.
        let after = self.moments().partition_point(|m| m.t_s <= t_s);
        pose(&Self::at(self, t_s, &mut after.saturating_sub(1)).0.pose)
    }

    fn length_s(&self) -> f64 {
        Self::length_s(self)
    }

    fn rate_hz(&self) -> Option<f64> {
        let step = |pair: &[Moment]| pair[1].t_s - pair[0].t_s;
        let mut steps: Vec<f64> = self.moments().windows(2).map(step).collect();
        let middle = steps.len() / 2;
        Some(1.0 / *steps.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

fn pose(pose: &palpate_device::Pose) -> Pose {
    let q = pose.orientation;
    Pose {
        position_m: pose.position.into(),
        orientation: [q.i, q.j, q.k, q.w],
    }
}
