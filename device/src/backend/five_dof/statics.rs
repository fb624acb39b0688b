//! From a force and a torque on the probe to torques of the motors (figure 4.6, equations 4.9 to 4.12).
//!
//! Each arm pushes its end of the probe:
//!
//! ```text
//! T⊥  = T - (T·r_p) r_p
//! f_L = F/2 + (T⊥ x r_p)/d       f_R = F/2 - (T⊥ x r_p)/d       d = |P_L - P_R|
//! τ   = blockdiag(J_L, J_R)ᵀ (f_L, f_R)
//! ```
//!
//! Two forces on the probe's axis can not produce a torque about it, so the device lacks the sixth degree of
//! freedom.

use nalgebra::Vector3;

use super::arm::Angles;
use super::linkage::{Linkage, Probe};
use crate::Wrench;

/// Manipulability below which torques fade, to zero in a singular posture. There the motors would load the links
/// instead of the hand. With the lengths of 2007, 0.05 is 5 degrees from links in line at a reach of 180 mm, or an
/// end 17 mm from the arm's first axis.
pub const SINGULAR: f64 = 0.05;

/// Torques of the motors, N·m, and how far they render the wrench.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Torques {
    /// Of the left arm's motors and the right arm's.
    pub nm: [Vector3<f64>; 2],
    /// The rendered fraction of the wrench, 0 to 1.
    pub share: f64,
}

/// Forces on the left and the right end of the probe, N, equivalent to this wrench about its pivot except for the
/// torque about its axis.
pub fn end_forces(probe: &Probe, wrench: &Wrench) -> [Vector3<f64>; 2] {
    let axis = probe.axis.into_inner();
    let across = wrench.torque - axis * wrench.torque.dot(&axis);
    let turning = across.cross(&axis) / probe.length_m;
    let half = wrench.force * 0.5;
    [half + turning, half - turning]
}

/// Torques that render `wrench` on the probe, each at most `limit_nm`. One common factor reduces all of them, so
/// that force and torque keep their directions.
pub fn torques(linkage: &Linkage, angles: &[Angles; 2], wrench: &Wrench, limit_nm: f64) -> Torques {
    let probe = linkage.probe(angles);
    // Coincident ends define no axis.
    let apart = Probe {
        length_m: probe.length_m.max(0.1 * linkage.probe_m),
        ..probe
    };
    let forces = end_forces(&apart, wrench);
    let of = |a: usize| linkage.arms[a].jacobian(&angles[a]).tr_mul(&forces[a]);
    let asked = [of(0), of(1)];
    let fade = (linkage.manipulability(angles) / SINGULAR).min(1.0);
    let most = asked.iter().map(Vector3::amax).fold(0.0, f64::max) * fade;
    let share = if most > limit_nm {
        fade * limit_nm / most
    } else {
        fade
    };
    Torques {
        nm: asked.map(|t| t * share),
        share,
    }
}
