//! Laws of the linkage, and of the device on its simulated boards.

mod boards;
mod kinematics;

use nalgebra::Vector3;

use super::Linkage;

/// The middle of its workspace, m.
pub(super) fn middle() -> Vector3<f64> {
    super::Middle::of(&Linkage::default()).unwrap().pivot
}
