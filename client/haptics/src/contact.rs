//! What the haptic loop knows of the tissue between two solves.
//!
//! The solver relaxes the tissue around the tool a few hundred times a second; the loop needs a
//! force a thousand times a second, at positions that were not solved. Around the solved position
//! x0 the force on the tool is linear:
//!
//! ```text
//! f(x, v) = f0 − K (x − x0) − B v
//! ```
//!
//! with K symmetric positive semidefinite, so that moving deeper raises the push outwards. (Texts
//! that write F0 + K (x − x0) mean the derivative of the force, which is −K here.)

use nalgebra::{Matrix3, Vector3};
use palpate_protocol::ClientTime;

/// Contacts in one model. One ball or one blade tip touches at one place; tools that touch along
/// a line will need several planes, and this bound then grows with the size of [`ContactModel`],
/// which is copied whole between threads.
pub const CONTACTS_MAX: usize = 1;

/// The largest component of a model's force, N, and the largest of its coefficients (stiffness in
/// N/m, damping in N·s/m, lengths in m) in [`COEFFICIENT_MAX`]. A solver that says more has
/// diverged, and sums of such numbers could overflow; the model is refused.
const FORCE_MAX_N: f64 = 1e6;

/// See [`FORCE_MAX_N`].
const COEFFICIENT_MAX: f64 = 1e9;

/// The tissue as the tool feels it near one solved position. Plain data, copied between threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactModel {
    /// Version of the topology that was solved; it changes with every cut.
    pub topology_version: u32,
    /// When it was solved. A new value means a new model.
    pub solved_at: ClientTime,
    /// Position of the tool at the solve (x0), m: that of [`Sample::pose`](palpate_device::Sample)
    /// which was solved, not the point of the surface.
    pub x0: Vector3<f64>,
    /// Force on the tool there (f0), N, without friction. The loop uses its part along the normal;
    /// what acts along the surface is the friction stage's.
    pub f0: Vector3<f64>,
    /// Stiffness K, N/m, symmetric positive semidefinite.
    pub stiffness: Matrix3<f64>,
    /// Damping B, N·s/m.
    pub damping: f64,
    /// Unit normal of the surface, out of the tissue.
    pub normal: Vector3<f64>,
    /// Coefficient of static friction.
    pub mu_static: f64,
    /// Coefficient of dynamic friction, at most the static one.
    pub mu_dynamic: f64,
    /// How far from x0 the linear law may be believed, m. Further away the force fades, so give
    /// it at least what a hand moves between two models: 0.5 m/s times 10 ms is 5 mm.
    pub radius: f64,
    /// Whether the tool touches at all; when not, there is no force.
    pub in_contact: bool,
    /// What others have put into the tissue since they began, less what they have got back, J. It may come back
    /// to this hand; see [`Passivity`](crate::Passivity).
    pub others_j: f64,
}

impl ContactModel {
    /// The tool touches nothing.
    pub const FREE: Self = Self {
        topology_version: 0,
        solved_at: ClientTime::ZERO,
        x0: Vector3::new(0.0, 0.0, 0.0),
        f0: Vector3::new(0.0, 0.0, 0.0),
        stiffness: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        damping: 0.0,
        normal: Vector3::new(0.0, 0.0, 1.0),
        mu_static: 0.0,
        mu_dynamic: 0.0,
        radius: 0.0,
        in_contact: false,
        others_j: 0.0,
    };

    /// The tool touches nothing, as of `solved_at`.
    pub const fn free_at(solved_at: ClientTime, topology_version: u32) -> Self {
        Self {
            topology_version,
            solved_at,
            ..Self::FREE
        }
    }

    /// The linear law at `x` (m) and `v` (m/s), N: not yet one-sided, not yet with friction.
    pub fn linear_force(&self, x: &Vector3<f64>, v: &Vector3<f64>) -> Vector3<f64> {
        self.f0 - self.stiffness * (x - self.x0) - self.damping * v
    }

    /// Whether the loop may use it: finite, a unit normal, no negative coefficient, nothing beyond
    /// all measure. A model that is not is never taken, and the one before it ages.
    pub fn is_usable(&self) -> bool {
        // A comparison with a number that is none is false.
        let scalars = [self.damping, self.mu_static, self.mu_dynamic, self.radius];
        self.f0.iter().all(|c| c.abs() <= FORCE_MAX_N)
            && self
                .x0
                .iter()
                .chain(&self.stiffness)
                .all(|c| c.abs() <= COEFFICIENT_MAX)
            && scalars.iter().all(|c| (0.0..=COEFFICIENT_MAX).contains(c))
            && self.others_j.abs() <= COEFFICIENT_MAX
            && self.normal.iter().all(|c| c.is_finite())
            && (!self.in_contact || (self.normal.norm() - 1.0).abs() < 1e-3)
    }

    /// Stiffness along the normal, N/m.
    pub fn normal_stiffness(&self) -> f64 {
        self.normal.dot(&(self.stiffness * self.normal)).max(0.0)
    }

    /// Stiffness across the normal, N/m: the mean of the two tangential directions.
    ///
    /// A solver that lets the contact slide freely reports next to none; the material sticks to
    /// the tool all the same, so below a tenth of the normal stiffness two thirds of that are
    /// taken, the ratio of an incompressible half-space (Mindlin 1949: 2 (1 − ν) / (2 − ν)).
    pub fn tangential_stiffness(&self) -> f64 {
        let normal = self.normal_stiffness();
        let tangential = 0.5 * (self.stiffness.trace() - normal);
        if tangential >= 0.1 * normal {
            tangential.max(0.0)
        } else {
            normal * 2.0 / 3.0
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::ContactModel;

    fn pressed() -> ContactModel {
        ContactModel {
            f0: Vector3::new(0.0, 0.0, 2.0),
            stiffness: Matrix3::from_diagonal(&Vector3::new(100.0, 120.0, 400.0)),
            in_contact: true,
            radius: 0.01,
            ..ContactModel::FREE
        }
    }

    #[test]
    fn deeper_is_a_stronger_push_outwards() {
        let deeper = pressed().linear_force(&Vector3::new(0.0, 0.0, -0.001), &Vector3::zeros());
        assert!((deeper.z - 2.4).abs() < 1e-12);
    }

    #[test]
    fn stiffness_splits_along_and_across_the_normal() {
        let m = pressed();
        assert!((m.normal_stiffness() - 400.0).abs() < 1e-9);
        assert!((m.tangential_stiffness() - 110.0).abs() < 1e-9);
        let slippery = ContactModel {
            stiffness: Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 300.0)),
            ..m
        };
        assert!((slippery.tangential_stiffness() - 200.0).abs() < 1e-9);
    }

    #[test]
    fn a_model_with_one_bad_number_is_not_usable() {
        assert!(pressed().is_usable() && ContactModel::FREE.is_usable());
        let n = f64::NAN;
        for bad in [
            ContactModel {
                f0: Vector3::new(0.0, n, 0.0),
                ..pressed()
            },
            ContactModel {
                stiffness: Matrix3::repeat(n),
                ..pressed()
            },
            ContactModel {
                mu_static: -0.1,
                ..pressed()
            },
            ContactModel {
                f0: Vector3::repeat(f64::MAX),
                ..pressed()
            },
            ContactModel {
                damping: f64::MAX,
                ..pressed()
            },
            ContactModel {
                radius: f64::INFINITY,
                ..pressed()
            },
            ContactModel {
                normal: Vector3::zeros(),
                ..pressed()
            },
            ContactModel {
                others_j: n,
                ..pressed()
            },
        ] {
            assert!(!bad.is_usable(), "{bad:?}");
        }
    }
}
