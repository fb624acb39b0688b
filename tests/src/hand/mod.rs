//! Hands whose motion is known at every moment, so that what a network makes of it can be compared with what it was.
//!
//! | | motion |
//! | --- | --- |
//! | [`Recorded`] | what somebody's hand did, from a table of times and places |
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
    /// Where the tool is `t_s` seconds after the motion began. Before that it is where it begins, after the end where
    /// it ends.
    fn at(&self, t_s: f64) -> Pose;

    /// How long it goes on, s; infinity for one without an end.
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

/// A device's pose as the wire knows it.
fn pose(pose: &palpate_device::Pose) -> Pose {
    let q = pose.orientation;
    Pose {
        position_m: pose.position.into(),
        orientation: [q.i, q.j, q.k, q.w],
    }
}
