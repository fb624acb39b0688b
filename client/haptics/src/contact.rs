//! The local contact model that the haptic loop evaluates between two solves.
//!
//! The solver relaxes the tissue around the tool a few hundred times a second; the loop needs forces and torques a
//! thousand times a second, at other poses. Around the solved pose (x0, R0) each active contact point i is
//! displaced, at the pose (x, R) and the velocities v and ω, by
//!
//! ```text
//! d_i = x − x0 + (R R0ᵀ − I) r_i,     v_i = v + ω × (R R0ᵀ r_i)         r_i the lever at the solve
//! ```
//!
//! Its normal force on the tool is linear in both ([`Touch`]); its tangential force is stick-slip friction. The
//! forces f on the tool sum to
//!
//! ```text
//! F = Σ f_i,     T = Σ (R R0ᵀ r_i) × f_i + C        about the pivot
//! ```
//!
//! with C the solved torque that the contact points do not explain. A model of one contact point at the pivot is a
//! point contact.

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use palpate_device::{Buttons, Pose};
use palpate_protocol::ClientTime;

use crate::Touch;
use crate::touch::{COEFFICIENT_MAX, FORCE_MAX_N};

/// Maximum number of contact points of a tool. A line of 16 stations or a plate of 4 by 4 cells gives the same
/// forces and torques as half as many within 2 % (tested in `contact_points`). A model has 3 KB, which are copied
/// between threads.
pub const CONTACTS_MAX: usize = 16;

/// The tissue near one solved pose of the tool. Plain data, copied between threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactModel {
    /// Topology version of the solve; every cut changes it.
    pub topology_version: u32,
    /// Solve time. A new value means a new model.
    pub solved_at: ClientTime,
    /// Position of the tool's pivot in the solve (x0), m: that of the [`Sample`](palpate_device::Sample) or one predicted
    /// from it, not a point of the surface.
    pub x0: Vector3<f64>,
    /// Orientation of the tool at the solve (R0).
    pub turn0: UnitQuaternion<f64>,
    /// The contact points of the tool, by their index on it.
    pub touches: [Touch; CONTACTS_MAX],
    /// Remainder of the solved torque about the pivot beyond Σ r × f0 (C), N·m. It scales with the normal force, so
    /// it vanishes when the tool lifts off.
    pub couple: Vector3<f64>,
    /// Radius of validity of the linear law, for the pivot and each active contact point, m. The force fades beyond
    /// it. Choose at least the travel of a hand between two models: 0.5 m/s times 10 ms is 5 mm.
    pub radius: f64,
    /// Net work of the other participants on the tissue since they joined, J. It may return to this hand; see
    /// the passivity controller.
    pub external_work_j: f64,
    /// Limit of the rendered force beside that of the device, N; infinite for none.
    pub force_limit_n: f64,
    /// Whether the tool is a needle in the tissue; other sites follow this state.
    pub is_inserted: bool,
    /// Whether the blade was cutting in the solve; `None` for other tools.
    pub was_cutting: Option<bool>,
    /// Whether the tool took no part in the solve, or its force is not trusted: the session or the tool is paused, the link is
    /// lost, or there is no tissue yet. The hand moves freely meanwhile, also into the tissue.
    pub is_absent: bool,
}

impl ContactModel {
    /// The tool touches nothing.
    pub const FREE: Self = Self {
        topology_version: 0,
        solved_at: ClientTime::ZERO,
        x0: Vector3::new(0.0, 0.0, 0.0),
        turn0: Unit::new_unchecked(Quaternion::new(1.0, 0.0, 0.0, 0.0)),
        touches: [Touch::NONE; CONTACTS_MAX],
        couple: Vector3::new(0.0, 0.0, 0.0),
        radius: 0.0,
        external_work_j: 0.0,
        force_limit_n: f64::INFINITY,
        is_inserted: false,
        was_cutting: None,
        is_absent: false,
    };

    /// The tool touches nothing, as of `solved_at`.
    pub const fn free_at(solved_at: ClientTime, topology_version: u32) -> Self {
        Self {
            topology_version,
            solved_at,
            ..Self::FREE
        }
    }

    /// The tool takes no part, as of `solved_at`.
    pub const fn absent_at(solved_at: ClientTime, topology_version: u32) -> Self {
        Self {
            is_absent: true,
            ..Self::free_at(solved_at, topology_version)
        }
    }

    /// A tool with one active contact point, its first; otherwise [`FREE`](Self::FREE).
    pub const fn single(touch: Touch) -> Self {
        let mut touches = [Touch::NONE; CONTACTS_MAX];
        touches[0] = touch;
        Self {
            touches,
            ..Self::FREE
        }
    }

    /// Whether any contact point is active; without one there is no force.
    pub fn in_contact(&self) -> bool {
        self.touches.iter().any(|t| t.touches)
    }

    /// The active contact points.
    pub fn touching(&self) -> impl Iterator<Item = &Touch> {
        self.touches.iter().filter(|t| t.touches)
    }

    /// Whether the model is valid for a tool with these buttons. A pressing blade feels contact, a cutting blade only the
    /// resistance at its edge, so a model of one state is invalid in the other.
    pub(crate) fn is_valid_for(&self, buttons: Buttons) -> bool {
        self.was_cutting
            .is_none_or(|cut| cut == buttons.contains(Buttons::PRIMARY))
    }

    /// The same model without contact.
    pub(crate) fn without_contact(&self) -> Self {
        Self {
            touches: Self::FREE.touches,
            couple: Self::FREE.couple,
            ..*self
        }
    }

    /// Force on the tool at the solve, N, without friction.
    pub fn force(&self) -> Vector3<f64> {
        self.touching().map(|t| t.f0).sum()
    }

    /// Torque on the tool about its pivot at the solve, N·m, without friction.
    pub fn torque(&self) -> Vector3<f64> {
        self.touching()
            .map(|t| t.lever.cross(&t.f0))
            .sum::<Vector3<f64>>()
            + self.couple
    }

    /// Sum of the normal stiffnesses of all active contact points, N/m.
    pub fn normal_stiffness(&self) -> f64 {
        self.touching().map(Touch::normal_stiffness).sum()
    }

    /// The pose that was solved.
    pub fn pose(&self) -> Pose {
        Pose {
            position: self.x0,
            orientation: self.turn0,
        }
    }

    /// Whether the pivot or an active contact point of a tool at `pose` has left the radius of validity.
    pub fn is_outside_at(&self, pose: &Pose) -> bool {
        let moved = pose.position - self.x0;
        let turned = pose.orientation * self.turn0.inverse();
        moved.norm() > self.radius
            || self
                .touching()
                .any(|t| (moved + (turned * t.lever - t.lever)).norm() > self.radius)
    }

    /// Whether the loop may use the model: finite, unit normals, no negative coefficient, within the magnitude
    /// bounds. The chain rejects any other model, and the previous one ages.
    pub fn is_usable(&self) -> bool {
        // A comparison with NaN is false.
        self.force_limit_n >= 0.0
            && self.x0.iter().all(|c| c.abs() <= COEFFICIENT_MAX)
            && (self.turn0.coords.norm() - 1.0).abs() < 1e-3
            && self.couple.iter().all(|c| c.abs() <= FORCE_MAX_N)
            && (0.0..=COEFFICIENT_MAX).contains(&self.radius)
            && self.external_work_j.abs() <= COEFFICIENT_MAX
            && self.touches.iter().all(Touch::is_usable)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, UnitQuaternion, Vector3};
    use palpate_device::Pose;

    use super::{CONTACTS_MAX, ContactModel};
    use crate::Touch;

    fn pressed() -> ContactModel {
        ContactModel {
            radius: 0.01,
            ..ContactModel::single(touch())
        }
    }

    fn touch() -> Touch {
        Touch::at_pivot(
            Vector3::new(0.0, 0.0, 2.0),
            Matrix3::from_diagonal_element(400.0),
            Vector3::z(),
        )
    }

    #[test]
    fn a_model_with_one_invalid_number_is_not_usable() {
        assert!(pressed().is_usable() && ContactModel::FREE.is_usable());
        let n = f64::NAN;
        let bad_touches = [
            Touch {
                f0: Vector3::new(0.0, n, 0.0),
                ..touch()
            },
            Touch {
                stiffness: Matrix3::repeat(n),
                ..touch()
            },
            Touch {
                mu_static: -0.1,
                ..touch()
            },
            Touch {
                f0: Vector3::repeat(f64::MAX),
                ..touch()
            },
            Touch {
                damping: f64::MAX,
                ..touch()
            },
            Touch {
                normal: Vector3::zeros(),
                ..touch()
            },
            Touch {
                lever: Vector3::new(n, 0.0, 0.0),
                ..touch()
            },
            Touch {
                pressed_n: n,
                ..touch()
            },
        ];
        for bad in bad_touches {
            // At any contact point.
            for place in [0, CONTACTS_MAX - 1] {
                let mut model = pressed();
                model.touches[place] = bad;
                assert!(!model.is_usable(), "{bad:?}");
            }
        }
        let mut turned = pressed();
        turned.turn0.as_mut_unchecked().coords.x = n;
        for bad in [
            turned,
            ContactModel {
                radius: f64::INFINITY,
                ..pressed()
            },
            ContactModel {
                external_work_j: n,
                ..pressed()
            },
            ContactModel {
                couple: Vector3::repeat(n),
                ..pressed()
            },
        ] {
            assert!(!bad.is_usable(), "{bad:?}");
        }
    }

    #[test]
    fn turning_in_place_leaves_the_radius_at_the_far_contact_point() {
        let mut model = pressed();
        model.touches[3] = Touch {
            lever: Vector3::new(0.1, 0.0, 0.0),
            ..touch()
        };
        let turned = |angle| Pose {
            orientation: UnitQuaternion::new(Vector3::z() * angle),
            ..Pose::default()
        };
        assert!(!model.is_outside_at(&turned(0.09)) && model.is_outside_at(&turned(0.11)));
        assert!(!pressed().is_outside_at(&turned(1.0)));
    }

    #[test]
    fn the_solved_torque_is_that_of_the_contact_points_and_the_couple() {
        let mut model = pressed();
        model.touches[0].lever.x = 0.1;
        model.couple.z = 0.3;
        assert!((model.torque() - Vector3::new(0.0, -0.2, 0.3)).norm() < 1e-12);
        assert_eq!(model.force(), Vector3::new(0.0, 0.0, 2.0));
    }
}
