//! An analytic tissue: a half-space of springs, and the contact models that a solver would return for it.

use nalgebra::{Matrix3, Unit, Vector3};
use palpate_haptics::{ContactModel, Touch};
use palpate_protocol::ClientTime;

use super::fault::BadModel;

/// Solve period, µs: that of the client's solver.
pub(super) const SOLVE_EVERY_US: i64 = 4_000;

/// Validity radius of a model around the solved position, m.
const RADIUS_M: f64 = 8e-3;

/// A half-space through the origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tissue {
    pub normal: Unit<Vector3<f64>>,
    /// Stiffness, N/m.
    pub stiffness: f64,
    /// Damping, N·s/m.
    pub damping: f64,
    pub mu_static: f64,
    pub mu_dynamic: f64,
    pub delay_us: i64,
    /// Begin of the first solve, µs of the run.
    pub phase_us: i64,
}

impl Tissue {
    /// The point at height `away` (m), `x` and `y` (m) along the surface.
    pub fn above(&self, away: f64, x: f64, y: f64) -> Vector3<f64> {
        let side = Vector3::new(x, y, 0.0);
        side - *self.normal * self.normal.dot(&side) + *self.normal * away
    }

    /// Contact model of a tool at `x` (m), solved at `now` on the client clock. Every contact model of the
    /// experiment is made here.
    pub fn model(&self, now: ClientTime, x: &Vector3<f64>) -> ContactModel {
        let depth = -self.normal.dot(x);
        let normal = *self.normal;
        ContactModel {
            topology_version: 1,
            solved_at: now,
            x0: *x,
            radius: RADIUS_M,
            ..ContactModel::single(Touch {
                touches: depth > 0.0,
                damping: self.damping,
                mu_static: self.mu_static,
                mu_dynamic: self.mu_dynamic,
                ..Touch::at_pivot(
                    normal * (self.stiffness * depth.max(0.0)),
                    Matrix3::from_diagonal_element(self.stiffness),
                    normal,
                )
            })
        }
    }
}

pub fn damaged(model: &ContactModel, how: BadModel) -> ContactModel {
    let mut bad = *model;
    let touch = &mut bad.touches[0];
    let normal = touch.normal;
    match how {
        BadModel::ForceNan => {
            touch.f0.y = f64::NAN;
            touch.touches = true;
        }
        BadModel::StiffnessInfinite => {
            touch.stiffness = Matrix3::repeat(f64::INFINITY);
            touch.touches = true;
        }
        BadModel::NormalZero => {
            touch.normal = Vector3::zeros();
            touch.touches = true;
        }
        BadModel::ForceMax => {
            touch.f0 = Vector3::repeat(f64::MAX);
            touch.touches = true;
        }
        BadModel::ForceThousandfold => {
            touch.f0 = normal * 1e5;
            touch.pressed_n = 1e5;
            touch.touches = true;
        }
        BadModel::NormalAnywhere => {
            touch.normal = Vector3::new(-normal.z, 0.0, normal.x).normalize();
        }
        BadModel::FromTheFuture => {
            bad.solved_at = ClientTime::from_micros(model.solved_at.as_micros() + 3_600_000_000);
        }
        BadModel::WorkOfOthers => bad.external_work_j = 1e8,
    }
    bad
}
