//! Limits of the device models that the library drives.
//!
//! The library reports the model but not its limits. Forces, stiffnesses and reach come from CHAI3D's public table.
//! The maker states the forces as continuous, so the peak force equals it. An unlisted model gets the limits of the
//! weakest.

use nalgebra::Vector3;

use crate::{DeviceCaps, Workspace};

/// Limits of one model.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Limits {
    /// N.
    force_n: f64,
    /// N·m; zero for an axis without motors.
    torque_nm: f64,
    /// N/m.
    stiffness_n_per_m: f64,
    /// From the middle, m.
    reach_m: f64,
}

const fn limits(force_n: f64, torque_nm: f64, stiffness_n_per_m: f64, reach_m: f64) -> Limits {
    Limits {
        force_n,
        torque_nm,
        stiffness_n_per_m,
        reach_m,
    }
}

/// By the value of `dhdGetSystemType`.
fn of(system_type: i32) -> Limits {
    match system_type {
        // delta.3, with its number of before 3.0; delta.6
        31 | 63 => limits(20.0, 0.0, 5000.0, 0.15),
        61 | 62 | 64 => limits(20.0, 0.2, 5000.0, 0.15),
        // omega.3, .6 and .7 for either hand
        32..=37 => limits(12.0, 0.0, 5000.0, 0.075),
        // sigma.7; sigma.6+
        104 | 105 => limits(12.0, 0.2, 4000.0, 0.075),
        106 | 107 => limits(12.0, 0.2, 4000.0, 0.09),
        // Falcon, and whatever is not known
        _ => limits(8.0, 0.0, 3000.0, 0.04),
    }
}

/// Capabilities of a device of this type, in its own frame. The half width of the workspace box is 1.5 times the
/// table's reach, within which it renders well.
pub(super) fn caps(
    system_type: i32,
    name: String,
    has_wrist: bool,
    has_gripper: bool,
) -> DeviceCaps {
    let limits = of(system_type);
    let half = Vector3::repeat(1.5 * limits.reach_m);
    let turns = limits.torque_nm > 0.0;
    DeviceCaps {
        name,
        dof_in: 3 + if has_wrist { 3 } else { 0 } + u8::from(has_gripper),
        dof_out: if turns { 6 } else { 3 },
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: limits.force_n,
        continuous_force_n: limits.force_n,
        max_torque_nm: limits.torque_nm,
        max_stiffness_n_per_m: limits.stiffness_n_per_m,
        rate_hz: 1000.0,
    }
}

#[cfg(test)]
mod tests {
    use super::{caps, of};

    #[test]
    fn an_unknown_model_has_the_weakest_limits() {
        let unknown = of(9999);
        for known in [31, 33, 35, 60, 63, 64, 104, 106] {
            assert!(unknown.force_n <= of(known).force_n);
            assert!(unknown.stiffness_n_per_m <= of(known).stiffness_n_per_m);
        }
        let falcon = caps(60, "FALCON".to_owned(), false, false);
        assert_eq!((falcon.dof_in, falcon.dof_out), (3, 3));
        let sigma = caps(104, "sigma.7".to_owned(), true, true);
        assert_eq!((sigma.dof_in, sigma.dof_out), (7, 6));
    }
}
