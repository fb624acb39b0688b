//! Reachable poses of the probe: the middle of the reach, the workspace, and manipulability maps.

use nalgebra::{Unit, UnitQuaternion, Vector3};

use super::arm::Angles;
use super::linkage::Linkage;
use crate::{OpenError, Workspace};

/// How far the probe may be tilted out of y everywhere in the workspace, rad.
pub const TILT_RAD: f64 = 0.52;
/// Minimum manipulability in the workspace: twice the value at which torques begin to fade.
const LEFT: f64 = 0.1;
/// Bisections of the workspace's size.
const ROUNDS: usize = 24;

/// The calibration posture and its workspace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Middle {
    /// Position of the pivot, m.
    pub pivot: Vector3<f64>,
    /// The angles there, rad, with the probe along y.
    pub angles: [Angles; 2],
    /// Half the side of the workspace, m.
    pub half_m: f64,
}

impl Middle {
    /// The posture with upper links hanging down and lower links level, or nearly so where the arms differ.
    pub fn of(linkage: &Linkage) -> Result<Self, OpenError> {
        // Each end turns in from its own axis; the pivot is in the middle of the two.
        let [left, right] = &linkage.arms;
        let half = 0.5 * linkage.probe_m;
        let ahead = |arm: &super::Arm| {
            let inwards = arm.offset_m - half;
            (arm.lower_m * arm.lower_m - inwards * inwards)
                .max(0.0)
                .sqrt()
        };
        let pivot = Vector3::new(
            0.5 * (ahead(left) + ahead(right)),
            0.0,
            -0.5 * (left.upper_m + right.upper_m),
        );
        let angles = linkage.angles(&pivot, &Vector3::y_axis())?;
        let mut middle = Self {
            pivot,
            angles,
            half_m: 0.0,
        };
        let [mut low, mut high] = [0.0, left.lower_m + left.upper_m];
        for _ in 0..ROUNDS {
            let half_m = 0.5 * (low + high);
            if (Self { half_m, ..middle }).is_sound(linkage) {
                low = half_m;
            } else {
                high = half_m;
            }
        }
        middle.half_m = low;
        Ok(middle)
    }

    /// The workspace cube, m.
    pub fn workspace(&self) -> Workspace {
        let half = Vector3::repeat(self.half_m);
        Workspace {
            min: self.pivot - half,
            max: self.pivot + half,
        }
    }

    /// Whether the probe can be held everywhere in the cube, at every tilt.
    fn is_sound(&self, linkage: &Linkage) -> bool {
        let offsets = [-1.0, -0.5, 0.0, 0.5, 1.0];
        offsets.iter().all(|x| {
            offsets.iter().all(|y| {
                offsets.iter().all(|z| {
                    let at = self.pivot + Vector3::new(*x, *y, *z) * self.half_m;
                    tilted().all(|axis| manipulability(linkage, &at, &axis) >= LEFT)
                })
            })
        })
    }
}

/// Along y, and tilted out of it in eight directions.
fn tilted() -> impl Iterator<Item = Unit<Vector3<f64>>> {
    let about = |k: u32| {
        let turn = f64::from(k) * std::f64::consts::FRAC_PI_4;
        Unit::new_unchecked(Vector3::new(turn.cos(), 0.0, turn.sin()))
    };
    let tilt =
        move |k: u32| UnitQuaternion::from_axis_angle(&about(k), TILT_RAD) * Vector3::y_axis();
    std::iter::once(Vector3::y_axis()).chain((0..8).map(tilt))
}

/// Manipulability with the pivot at `at` (m) and the probe along `axis`; zero out of reach.
pub fn manipulability(linkage: &Linkage, at: &Vector3<f64>, axis: &Unit<Vector3<f64>>) -> f64 {
    linkage
        .angles(at, axis)
        .map_or(0.0, |angles| linkage.manipulability(&angles))
}
