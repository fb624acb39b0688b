//! Hands with a known continuous motion, to compare with the motion after a network.
//!
//! | | motion |
//! | --- | --- |
//! | [`Recorded`] | a recorded hand, from a table of times and positions |
//! | [`Random`] | band-limited, with tremor, from a seed |
//! | [`Script`] | way points, as the demo and the experiments use them |

pub(crate) mod command;
mod random;
mod recorded;

use palpate_device::Script;
use palpate_protocol::Pose;

pub use random::{Random, Temper};
pub use recorded::{MotionFileError, Recorded};

/// A motion that is known at every moment.
pub trait Hand: Send + Sync {
    /// Pose `t_s` seconds after the start of the motion; constant before the start and after the end.
    fn at(&self, t_s: f64) -> Pose;

    /// Length, s; infinite for an endless motion.
    fn length_s(&self) -> f64;
}

impl Hand for Script {
    fn at(&self, t_s: f64) -> Pose {
        pose(&Script::pose(self, t_s).pose)
    }

    fn length_s(&self) -> f64 {
        if self.repeats() {
            f64::INFINITY
        } else {
            self.end_s()
        }
    }
}

/// Converts a device pose to a wire pose.
fn pose(pose: &palpate_device::Pose) -> Pose {
    let q = pose.orientation;
    Pose {
        position_m: pose.position.into(),
        orientation: [q.i, q.j, q.k, q.w],
    }
}
