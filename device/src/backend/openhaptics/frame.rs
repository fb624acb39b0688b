//! Conversion between the library's units and axes and ours.
//!
//! The library has x to the right, y up and z towards the user, in millimetres; all drivers here have y away from
//! the user and z up, in metres.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::{Pose, Workspace};

const MM: f64 = 1e-3;

/// From the library's axes to ours.
fn axes() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::new(
        1.0, 0.0, 0.0, //
        0.0, 0.0, -1.0, //
        0.0, 1.0, 0.0,
    ))
}

/// A direction or a rate; units are unchanged.
pub(super) fn turned(v: [f64; 3]) -> Vector3<f64> {
    axes() * Vector3::from(v)
}

/// Converts mm to m.
pub(super) fn metres(v: [f64; 3]) -> Vector3<f64> {
    turned(v) * MM
}

/// A force in the library's axes, N.
pub(super) fn back(v: Vector3<f64>) -> [f64; 3] {
    (axes().inverse() * v).into()
}

/// A pose from 16 numbers in column order.
pub(super) fn pose(m: &[f64; 16]) -> Pose {
    let turn =
        Rotation3::from_matrix_unchecked(Matrix3::from_fn(|row, column| m[4 * column + row]));
    let turn = UnitQuaternion::from_rotation_matrix(&(axes() * turn));
    Pose {
        position: metres([m[12], m[13], m[14]]),
        orientation: UnitQuaternion::new_normalize(turn.into_inner()),
    }
}

/// A workspace from two corners in mm; `None` if invalid.
pub(super) fn workspace(m: &[f64; 16]) -> Option<Workspace> {
    let (a, b) = (metres([m[0], m[1], m[2]]), metres([m[3], m[4], m[5]]));
    let (min, max) = (a.inf(&b), a.sup(&b));
    let is_box = (max - min).iter().all(|side| (1e-3..=20.0).contains(side));
    is_box.then_some(Workspace { min, max })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::{back, metres, pose, turned, workspace};

    #[test]
    fn the_axes_map_right_up_and_towards_the_user() {
        assert_eq!(turned([1.0, 0.0, 0.0]), Vector3::x());
        assert_eq!(turned([0.0, 1.0, 0.0]), Vector3::z());
        assert_eq!(turned([0.0, 0.0, 1.0]), -Vector3::y());
        assert_eq!(metres([0.0, 80.0, 0.0]), Vector3::new(0.0, 0.0, 0.08));
        let there = Vector3::new(1.0, -2.0, 3.0);
        assert_eq!(turned(back(there)), there);
    }

    #[test]
    fn a_transform_is_read_column_after_column() {
        // A quarter turn about the library's y: its x axis maps to -z, away from the user.
        let m = [
            0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 10.0, 20.0, 30.0, 1.0,
        ];
        let pose = pose(&m);
        assert!((pose.position - Vector3::new(0.01, -0.03, 0.02)).norm() < 1e-15);
        assert!((pose.orientation * Vector3::x() - Vector3::y()).norm() < 1e-12);
    }

    #[test]
    fn a_workspace_has_its_corners_in_order() {
        let mut m = [0.0; 16];
        m[..6].copy_from_slice(&[-80.0, -60.0, -35.0, 80.0, 60.0, 35.0]);
        let found = workspace(&m).unwrap();
        assert_eq!(found.min, Vector3::new(-0.08, -0.035, -0.06));
        assert_eq!(workspace(&[0.0; 16]), None);
    }
}
