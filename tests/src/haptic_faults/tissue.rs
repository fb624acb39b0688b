//! A tissue that needs no solving: a half-space of springs, and what a solver would say of it.

use nalgebra::{Matrix3, Unit, Vector3};
use palpate_haptics::ContactModel;
use palpate_protocol::ClientTime;

use super::fault::BadModel;

/// From one solve to the next, µs: what a client's solver keeps.
pub(super) const SOLVE_EVERY_US: i64 = 4_000;

/// How far from the solved position a model may be believed, m.
const RADIUS_M: f64 = 8e-3;

/// A half-space through the origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tissue {
    /// Out of the tissue.
    pub normal: Unit<Vector3<f64>>,
    /// N/m.
    pub stiffness: f64,
    /// N·s/m.
    pub damping: f64,
    /// Static friction.
    pub mu_static: f64,
    /// Dynamic friction.
    pub mu_dynamic: f64,
    /// How long a solve takes, µs.
    pub delay_us: i64,
    /// When the first solve begins, µs of the run.
    pub phase_us: i64,
}

impl Tissue {
    /// The point `away` (m) above the surface, `x` and `y` (m) to the side.
    pub fn above(&self, away: f64, x: f64, y: f64) -> Vector3<f64> {
        let side = Vector3::new(x, y, 0.0);
        side - *self.normal * self.normal.dot(&side) + *self.normal * away
    }

    /// What a solver says of a tool at `x` (m), solved at `now` on the clock of the client. Every
    /// contact model of the experiment is made here.
    pub fn model(&self, now: ClientTime, x: &Vector3<f64>) -> ContactModel {
        let depth = -self.normal.dot(x);
        let normal = *self.normal;
        ContactModel {
            topology_version: 1,
            solved_at: now,
            x0: *x,
            f0: normal * (self.stiffness * depth.max(0.0)),
            stiffness: Matrix3::from_diagonal_element(self.stiffness),
            damping: self.damping,
            normal,
            mu_static: self.mu_static,
            mu_dynamic: self.mu_dynamic,
            radius: RADIUS_M,
            in_contact: depth > 0.0,
            ..ContactModel::FREE
        }
    }
}

/// `model`, gone wrong.
pub fn spoilt(model: ContactModel, how: BadModel) -> ContactModel {
    let mut bad = model;
    match how {
        BadModel::ForceNan => bad.f0.y = f64::NAN,
        BadModel::StiffnessInfinite => bad.stiffness = Matrix3::repeat(f64::INFINITY),
        BadModel::NormalZero => {
            bad.normal = Vector3::zeros();
            bad.in_contact = true;
        }
        BadModel::ForceMax => bad.f0 = Vector3::repeat(f64::MAX),
        BadModel::ForceThousandfold => {
            bad.f0 = model.normal * 1e5;
            bad.in_contact = true;
        }
        BadModel::NormalAnywhere => {
            bad.normal = Vector3::new(-model.normal.z, 0.0, model.normal.x).normalize();
        }
        BadModel::FromTheFuture => {
            bad.solved_at = ClientTime::from_micros(model.solved_at.as_micros() + 3_600_000_000);
        }
        BadModel::WorkOfOthers => bad.others_j = 1e8,
    }
    bad
}
