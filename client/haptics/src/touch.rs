//! One contact point of a tool.
//!
//! Around the solved pose its force on the tool is linear in its displacement (d) and its velocity (v):
//!
//! ```text
//! f(d, v) = f0 − K d − B v
//! ```
//!
//! with K symmetric positive semidefinite, so that deeper contact raises the outward force. (Texts that write F0 +
//! K d mean the derivative of the force, which is −K here.)

use nalgebra::{Matrix3, Vector3};

/// Maximum component of a contact force, N, or of a torque, N·m; [`COEFFICIENT_MAX`] bounds the coefficients
/// (stiffness in N/m, damping in N·s/m, lengths in m). Larger values come from a diverged solver, and their sums
/// could overflow; the model is rejected.
pub(crate) const FORCE_MAX_N: f64 = 1e6;

/// Ratio of the tangential to the normal stiffness of a contact that sticks to an incompressible half-space (Mindlin 1949:
/// 2 (1 − ν) / (2 − ν)).
pub const MINDLIN: f64 = 2.0 / 3.0;

/// See [`FORCE_MAX_N`].
pub(crate) const COEFFICIENT_MAX: f64 = 1e9;

/// One contact point of a tool, as solved. Its position in [`ContactModel::touches`](crate::ContactModel::touches)
/// is its index ON THE TOOL (a station along a line, a cell of a plate), so that its friction state persists from
/// model to model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touch {
    /// Whether the contact point is active. If not, no other field counts.
    pub touches: bool,
    /// Lever from the tool's pivot (the position of [`Sample::pose`](palpate_device::Sample)) to the contact point,
    /// m, along the scene's axes.
    pub lever: Vector3<f64>,
    /// Force on the tool there (f0), N, without friction. The loop uses its normal part; tangential forces come
    /// from the friction stage.
    pub f0: Vector3<f64>,
    /// Stiffness of this contact point alone (K), N/m, symmetric positive semidefinite. The loop uses its normal
    /// part.
    pub stiffness: Matrix3<f64>,
    /// Tangential stiffness against a sticking tool (`k_t`), N/m.
    pub tangential_stiffness: f64,
    /// Damping B, N·s/m.
    pub damping: f64,
    /// Unit normal of the surface, out of the tissue.
    pub normal: Vector3<f64>,
    /// Normal force summed over all sides, N, at least |f0|. Friction is proportional to it: the two sides of a
    /// needle's channel cancel in f0.
    pub pressed_n: f64,
    /// Coefficient of static friction.
    pub mu_static: f64,
    /// Coefficient of dynamic friction, at most the static one.
    pub mu_dynamic: f64,
}

impl Touch {
    /// An inactive contact point.
    pub const NONE: Self = Self {
        touches: false,
        lever: Vector3::new(0.0, 0.0, 0.0),
        f0: Vector3::new(0.0, 0.0, 0.0),
        stiffness: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        tangential_stiffness: 0.0,
        damping: 0.0,
        normal: Vector3::new(0.0, 0.0, 1.0),
        pressed_n: 0.0,
        mu_static: 0.0,
        mu_dynamic: 0.0,
    };

    /// A contact point at the pivot, pressed from one side with `f0` (N) along the unit `normal` against
    /// `stiffness` (N/m), without damping and friction. Its tangential stiffness is [`MINDLIN`] times the normal
    /// one.
    pub fn at_pivot(f0: Vector3<f64>, stiffness: Matrix3<f64>, normal: Vector3<f64>) -> Self {
        let at = Self {
            touches: true,
            f0,
            stiffness,
            normal,
            pressed_n: f0.norm(),
            ..Self::NONE
        };
        Self {
            tangential_stiffness: MINDLIN * at.normal_stiffness(),
            ..at
        }
    }

    /// Normal force that cancels in f0 between two sides (s), N. It persists while the contact point is active, and
    /// only friction uses it.
    pub fn squeeze_n(&self) -> f64 {
        (self.pressed_n - self.f0.norm()).max(0.0)
    }

    /// Stiffness along the normal, N/m.
    pub fn normal_stiffness(&self) -> f64 {
        self.normal.dot(&(self.stiffness * self.normal)).max(0.0)
    }

    /// Whether the loop may use it: finite, a unit normal, no negative coefficient, within the bounds.
    pub(crate) fn is_usable(&self) -> bool {
        // A comparison with NaN is false.
        let scalars = [
            self.damping,
            self.mu_static,
            self.mu_dynamic,
            self.pressed_n,
            self.tangential_stiffness,
        ];
        !self.touches
            || self.f0.iter().all(|c| c.abs() <= FORCE_MAX_N)
                && self
                    .lever
                    .iter()
                    .chain(&self.stiffness)
                    .all(|c| c.abs() <= COEFFICIENT_MAX)
                && scalars.iter().all(|c| (0.0..=COEFFICIENT_MAX).contains(c))
                && (self.normal.norm() - 1.0).abs() < 1e-3
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::Touch;

    fn pressed() -> Touch {
        let stiffness = Matrix3::from_diagonal(&Vector3::new(100.0, 120.0, 400.0));
        Touch::at_pivot(Vector3::new(0.0, 0.0, 2.0), stiffness, Vector3::z())
    }

    #[test]
    fn tangential_stiffness_is_two_thirds_of_the_normal_one() {
        let m = pressed();
        assert!((m.normal_stiffness() - 400.0).abs() < 1e-9);
        assert!((m.tangential_stiffness - 800.0 / 3.0).abs() < 1e-9);
    }

    #[test]
    fn a_one_sided_contact_has_no_squeeze() {
        assert_eq!(pressed().squeeze_n(), 0.0);
        let needle = Touch {
            pressed_n: 5.0,
            ..pressed()
        };
        assert!((needle.squeeze_n() - 3.0).abs() < 1e-12);
    }
}
