//! The one-sided contact law of one contact point between two solves.
//!
//! ```text
//! N(d, v) = max(−s, φ + g · d − B n·v),     |B n·v| <= |φ + g · d| + s
//! ```
//!
//! with φ the normal force at the solve, g = −k n its gradient, d the motion of the contact point since. A contact
//! pressed from one side has s = 0 and never pulls. Tissue that squeezes from two sides (a needle in its channel)
//! carries s beyond φ and holds the tool bilaterally, until one side loses contact. The second side can push back
//! with at most s. Friction is proportional to |N| + s.

use nalgebra::Vector3;
use palpate_device::Pose;

use crate::motion::Motion;
use crate::{ContactModel, coupling::Slope};

/// One law, with the input of its friction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Law {
    pub(crate) touches: bool,
    /// The pivot at the solve, m.
    pub(crate) at: Vector3<f64>,
    /// Lever from there to the contact point, m, along the scene's axes.
    pub(crate) lever: Vector3<f64>,
    /// The same along the tool's axes.
    pub(crate) on_tool: Vector3<f64>,
    /// φ, N.
    pub(crate) value: f64,
    /// g, N/m.
    pub(crate) gradient: Vector3<f64>,
    /// |d| saturates at this distance, m.
    pub(crate) reach: f64,
    pub(crate) normal: Vector3<f64>,
    pub(crate) damping: f64,
    /// Stiffness of the tissue along the normal, N/m, without the limit of the coupling.
    pub(crate) stiffness: f64,
    /// Stiffness across the normal, N/m.
    pub(crate) tangential: f64,
    /// s, N.
    pub(crate) squeeze: f64,
    pub(crate) mu_static: f64,
    pub(crate) mu_dynamic: f64,
}

/// Response of a law at a pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Response {
    /// The lever now, m, along the scene's axes.
    pub(crate) lever: Vector3<f64>,
    /// N, N.
    pub(crate) normal_force: f64,
    /// |N| + s, N.
    pub(crate) pressed: f64,
}

impl Law {
    /// The response of an inactive contact point.
    pub(crate) const FREE: Self = Self {
        touches: false,
        at: Vector3::new(0.0, 0.0, 0.0),
        lever: Vector3::new(0.0, 0.0, 0.0),
        on_tool: Vector3::new(0.0, 0.0, 0.0),
        value: 0.0,
        gradient: Vector3::new(0.0, 0.0, 0.0),
        reach: 0.0,
        normal: Vector3::new(0.0, 0.0, 1.0),
        damping: 0.0,
        stiffness: 0.0,
        tangential: 0.0,
        squeeze: 0.0,
        mu_static: 0.0,
        mu_dynamic: 0.0,
    };

    /// The law of contact point `index` of a model, with the slope `slope`.
    pub(crate) fn of(model: &ContactModel, index: usize, slope: &Slope) -> Self {
        let touch = &model.touches[index];
        if !touch.touches {
            return Self::FREE;
        }
        let normal = touch.normal;
        Self {
            touches: true,
            at: model.x0,
            lever: touch.lever,
            on_tool: model.turn0.inverse() * touch.lever,
            value: normal.dot(&touch.f0),
            gradient: normal * -slope.along,
            reach: model.radius,
            normal,
            damping: touch.damping,
            stiffness: touch.normal_stiffness(),
            tangential: slope.across,
            squeeze: touch.squeeze_n(),
            mu_static: touch.mu_static,
            mu_dynamic: touch.mu_dynamic.min(touch.mu_static),
        }
    }

    /// Flips the normal to the side of `old`. The solver's choice of side at a squeezed contact is arbitrary, and
    /// two opposite normals can not be interpolated.
    pub(crate) fn align_normal(&mut self, old: &Self) {
        let both = self.squeeze > 0.0 && old.squeeze > 0.0 && old.touches && self.touches;
        if both && old.normal.dot(&self.normal) < 0.0 {
            (self.normal, self.value, self.gradient) = (-self.normal, -self.value, -self.gradient);
        }
    }

    /// Total normal force at the solve, N.
    pub(crate) fn total_normal_force_at_solve(&self) -> f64 {
        self.value.max(-self.squeeze).abs() + self.squeeze
    }

    /// The response to a tool in `motion`.
    pub(crate) fn evaluate(&self, motion: &Motion) -> Response {
        let lever = motion.turn * self.on_tool;
        if !self.touches {
            return Response {
                lever,
                normal_force: 0.0,
                pressed: 0.0,
            };
        }
        let away = (motion.x - self.at) + (lever - self.lever);
        let far = away.norm();
        let within = if far > self.reach {
            away * (self.reach / far)
        } else {
            away
        };
        let floor = -self.squeeze;
        let spring = (self.value + self.gradient.dot(&within)).max(floor);
        // Bounded by the normal force, so that contact begins and ends without a step.
        let bound = spring.abs() + self.squeeze;
        let damper = self.damping * self.normal.dot(&motion.velocity_at(&lever));
        let normal_force = (spring - damper.clamp(-bound, bound)).max(floor);
        Response {
            lever,
            normal_force,
            pressed: normal_force.abs() + self.squeeze,
        }
    }

    /// The gradient at a held pose, N/m: zero where one side has lost contact.
    pub(crate) fn slope_at(&self, held: &Motion) -> Vector3<f64> {
        if self.evaluate(held).normal_force > -self.squeeze {
            self.gradient
        } else {
            Vector3::zeros()
        }
    }

    /// The same contact point relinearised at `pose`, with its `lever` (m, scene's axes) there.
    pub(crate) fn relinearised_at(self, pose: &Pose, lever: Vector3<f64>) -> Self {
        Self {
            at: pose.position,
            lever,
            on_tool: pose.orientation.inverse() * lever,
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use proptest::prelude::*;

    use super::Law;
    use crate::motion::Motion;

    fn law(squeeze: f64, damping: f64) -> Law {
        Law {
            touches: true,
            value: 1.0,
            gradient: Vector3::new(0.0, 0.0, -500.0),
            reach: 0.05,
            damping,
            squeeze,
            ..Law::FREE
        }
    }

    fn at(z: f64, vz: f64) -> Motion {
        Motion {
            x: Vector3::new(0.0, 0.0, z),
            turn: UnitQuaternion::identity(),
            v: Vector3::new(0.0, 0.0, vz),
            w: Vector3::zeros(),
        }
    }

    #[test]
    fn a_squeezed_contact_is_held_from_both_sides() {
        let responses = |z| law(2.0, 0.0).evaluate(&at(z, 0.0));
        assert!((responses(0.001).normal_force - 0.5).abs() < 1e-12);
        assert!((responses(0.004).normal_force + 1.0).abs() < 1e-12);
        assert!((responses(0.03).normal_force + 2.0).abs() < 1e-12);
        assert!((responses(0.002).pressed - 2.0).abs() < 1e-12);
    }

    #[test]
    fn rotation_presses_a_contact_point_on_a_lever() {
        let offset = Law {
            lever: Vector3::new(0.1, 0.0, 0.0),
            on_tool: Vector3::new(0.1, 0.0, 0.0),
            ..law(0.0, 0.0)
        };
        // A turn of 0.01 rad about +y lowers the end of a lever along x by a millimetre.
        let turned = Motion {
            turn: UnitQuaternion::new(Vector3::new(0.0, 0.01, 0.0)),
            ..at(0.0, 0.0)
        };
        assert!((offset.evaluate(&turned).normal_force - 1.5).abs() < 1e-4);
    }

    proptest! {
        #[test]
        fn a_one_sided_contact_never_pulls(
            z in -0.05f64..0.05, vz in -1.0f64..1.0, b in 0.0f64..50.0, s in 0.0f64..3.0,
        ) {
            prop_assert!(law(0.0, b).evaluate(&at(z, vz)).normal_force >= 0.0);
            prop_assert!(law(s, b).evaluate(&at(z, vz)).normal_force >= -s);
        }
    }
}
