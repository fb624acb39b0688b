//! Pose and velocity of the tool, the input of the stages.

use nalgebra::{UnitQuaternion, Vector3};
use palpate_device::{Pose, Sample};

/// A pose and its two velocities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Motion {
    /// Position of the pivot, m.
    pub(crate) x: Vector3<f64>,
    /// Rotation from the tool's axes to the scene's.
    pub(crate) turn: UnitQuaternion<f64>,
    /// Velocity of the pivot, m/s.
    pub(crate) v: Vector3<f64>,
    /// Angular velocity, rad/s, along the scene's axes.
    pub(crate) w: Vector3<f64>,
}

impl Motion {
    pub(crate) fn of(sample: &Sample) -> Self {
        Self {
            x: sample.pose.position,
            turn: sample.pose.orientation,
            v: sample.velocity,
            w: sample.angular_velocity,
        }
    }

    /// At the same pose, but at rest.
    pub(crate) fn held(&self) -> Self {
        Self {
            v: Vector3::zeros(),
            w: Vector3::zeros(),
            ..*self
        }
    }

    pub(crate) fn pose(&self) -> Pose {
        Pose {
            position: self.x,
            orientation: self.turn,
        }
    }

    /// Velocity of the point at `lever` (m, scene's axes) from the pivot, m/s.
    pub(crate) fn velocity_at(&self, lever: &Vector3<f64>) -> Vector3<f64> {
        self.v + self.w.cross(lever)
    }

    /// Displacement since the pose `before` of the point at `lever` (m, scene's axes, now) from the pivot, m.
    pub(crate) fn moved_since(&self, before: &Pose, lever: &Vector3<f64>) -> Vector3<f64> {
        let lever_before = before.orientation * (self.turn.inverse() * lever);
        (self.x - before.position) + (lever - lever_before)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use palpate_device::Pose;

    use super::Motion;

    #[test]
    fn a_contact_point_moves_with_its_tool() {
        // A quarter turn about z in a second, and 1 m/s along x.
        let quarter = std::f64::consts::FRAC_PI_2;
        let w = Vector3::new(0.0, 0.0, quarter);
        let now = Motion {
            x: Vector3::x(),
            turn: UnitQuaternion::new(w),
            v: Vector3::x(),
            w,
        };
        let lever = Vector3::new(0.0, 0.2, 0.0);
        let moved = now.moved_since(&Pose::default(), &lever);
        assert!(
            (moved - Vector3::new(0.8, 0.2, 0.0)).norm() < 1e-12,
            "{moved}"
        );
        let v = now.velocity_at(&lever);
        assert!(
            (v - Vector3::new(1.0 - 0.2 * quarter, 0.0, 0.0)).norm() < 1e-12,
            "{v}"
        );
    }
}
