//! The 5-DOF device of 2007: two arms of three motors each, and a probe between their ends.
//!
//! Forces are rendered along all three axes, torques about the two axes across the probe. The sources (Zhu 2003,
//! and a dissertation of 2007) give the mechanism, the lengths and the encoders. Motor limits, inertias and the
//! calibration posture are not published: a builder supplies them in [`Config`], and the simulated boards ([`Rig`])
//! use assumed values.
//!
//! - [`Arm`] and [`Linkage`]: forward and inverse kinematics, Jacobian, singular postures.
//! - [`torques`]: a wrench on the probe to torques of the motors.
//! - [`Encoder`], [`Drive`]: counts and codes; [`Port`]: the boards that carry them.
//! - [`FiveDof`]: all of it as a [`HapticDevice`](crate::HapticDevice).
//! - [`Rig`]: boards, motors, links and a hand, simulated; [`simulated`] puts all together.
//! - [`Middle`], [`manipulability`]: workspace and maps.

mod arm;
mod device;
mod linkage;
mod map;
mod port;
mod rates;
mod rig;
mod signals;
mod simulated;
mod statics;
#[cfg(test)]
mod tests;

pub use arm::{Angles, Arm, Side};
pub use device::{Config, FiveDof, PROBE_TOLERANCE_M};
pub use linkage::{Linkage, Probe};
pub use map::{Middle, TILT_RAD, manipulability};
pub use port::{Port, PortFault, Six};
pub use rig::{Rig, RigConfig};
pub use signals::{Drive, Encoder};
pub use simulated::{invented, simulated};
pub use statics::{SINGULAR, Torques, end_forces, torques};
