//! Input and output of a device: samples and wrenches.

use nalgebra::{UnitQuaternion, Vector3};

use crate::DeviceTime;

/// Position and orientation of the tool, in the frame of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Position of the tool's tip, m.
    pub position: Vector3<f64>,
    /// Rotation from the tool's frame to the scene's.
    pub orientation: UnitQuaternion<f64>,
}

impl Pose {
    /// The pose at `position` (m), with identity orientation.
    pub fn at(position: Vector3<f64>) -> Self {
        Self {
            position,
            orientation: UnitQuaternion::identity(),
        }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        is_finite(&self.position) && self.orientation.coords.iter().all(|c| c.is_finite())
    }
}

impl Default for Pose {
    fn default() -> Self {
        Self::at(Vector3::zeros())
    }
}

/// A force and a torque on the tool, and so on the hand that holds it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wrench {
    /// Force on the tool, N, in the frame of the scene.
    pub force: Vector3<f64>,
    /// Torque on the tool about its tip, N·m, in the frame of the scene.
    pub torque: Vector3<f64>,
}

impl Wrench {
    /// No force and no torque.
    pub const ZERO: Self = Self {
        force: Vector3::new(0.0, 0.0, 0.0),
        torque: Vector3::new(0.0, 0.0, 0.0),
    };

    /// A pure force, N.
    pub const fn from_force(force: Vector3<f64>) -> Self {
        Self {
            force,
            torque: Vector3::new(0.0, 0.0, 0.0),
        }
    }

    /// `share` of it.
    #[must_use]
    pub fn scaled(&self, share: f64) -> Self {
        Self {
            force: self.force * share,
            torque: self.torque * share,
        }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        is_finite(&self.force) && is_finite(&self.torque)
    }
}

/// Common code of sets of bits.
macro_rules! bit_set {
    ($set:ident) => {
        impl $set {
            /// The bits.
            pub const fn bits(self) -> u32 {
                self.0
            }

            /// Whether all of `other` are in it.
            pub const fn contains(self, other: Self) -> bool {
                self.0 & other.0 == other.0
            }

            /// These and `other`.
            #[must_use]
            pub const fn with(self, other: Self) -> Self {
                Self(self.0 | other.0)
            }
        }
    };
}

/// The buttons of a tool, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Buttons(u32);

impl Buttons {
    /// No button held.
    pub const NONE: Self = Self(0);
    /// The main button: a blade cuts, a grasper grabs, while it is held.
    pub const PRIMARY: Self = Self(1);
    /// The second button.
    pub const SECONDARY: Self = Self(1 << 1);

    /// Buttons from their bits; bit 0 is the primary one.
    pub const fn from_bits(bits: u32) -> Self {
        Self(bits)
    }
}

bit_set!(Buttons);

/// Faults that a device reports while it still answers, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Faults(u32);

impl Faults {
    /// No fault.
    pub const NONE: Self = Self(0);
    /// The time between two readings was too long to follow; the pose may have jumped.
    pub const TIME_JUMP: Self = Self(1);
    /// The motors are warm: the device may soon limit its force.
    pub const MOTORS_WARM: Self = Self(1 << 1);
    /// The tool is outside the workspace.
    pub const OUT_OF_WORKSPACE: Self = Self(1 << 2);
    /// The requested force exceeded the device's limit, and it protected itself.
    pub const OVER_FORCE: Self = Self(1 << 3);
    /// The link to the device lost a message.
    pub const COMMUNICATION: Self = Self(1 << 4);
    /// The emergency stop is pressed.
    pub const EMERGENCY_STOP: Self = Self(1 << 5);
    /// The pose is invalid: the device is not calibrated, or its readings contradict each other.
    pub const UNTRUSTED_POSE: Self = Self(1 << 6);

    const STOPPING: u32 = Self::OVER_FORCE.0
        | Self::COMMUNICATION.0
        | Self::EMERGENCY_STOP.0
        | Self::UNTRUSTED_POSE.0;

    /// Whether there is no fault.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether any of them forbids force, because the device's state or the hand's is unknown.
    pub const fn forbid_force(self) -> bool {
        self.0 & Self::STOPPING != 0
    }
}

bit_set!(Faults);

/// Maximum speed of a prediction, m/s: hands that touch something are slower, glitches of a device are not.
const SPEED_MAX_M_S: f64 = 1.0;

/// The same for rotations, rad/s.
const SPEED_MAX_RAD_S: f64 = 10.0;

/// One reading of a device; plain data that is copied between threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Time of the reading, on the device's clock.
    pub time: DeviceTime,
    /// Pose of the tool.
    pub pose: Pose,
    /// Velocity of the tip, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity of the tool, rad/s, in the frame of the scene.
    pub angular_velocity: Vector3<f64>,
    /// The buttons held.
    pub buttons: Buttons,
    /// Opening of a gripper from 0 (shut) to 1 (open); `None` for a tool without one.
    pub gripper: Option<f64>,
    /// The faults.
    pub faults: Faults,
}

impl Sample {
    /// A tool that rests at `pose`.
    pub fn resting(time: DeviceTime, pose: Pose) -> Self {
        Self {
            time,
            pose,
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            buttons: Buttons::NONE,
            gripper: None,
            faults: Faults::NONE,
        }
    }

    /// The pose `dt_s` seconds later at constant velocity, of at most 1 m/s and 10 rad/s.
    pub fn predicted_pose(&self, dt_s: f64) -> Pose {
        let turn = self.angular_velocity.cap_magnitude(SPEED_MAX_RAD_S) * dt_s;
        Pose {
            position: self.pose.position + self.velocity.cap_magnitude(SPEED_MAX_M_S) * dt_s,
            orientation: UnitQuaternion::from_scaled_axis(turn) * self.pose.orientation,
        }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.pose.is_finite()
            && is_finite(&self.velocity)
            && is_finite(&self.angular_velocity)
            && self.gripper.is_none_or(f64::is_finite)
    }
}

fn is_finite(v: &Vector3<f64>) -> bool {
    v.iter().all(|c| c.is_finite())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{Buttons, Faults, Pose, Sample, Wrench};
    use crate::DeviceTime;

    #[test]
    fn is_finite_detects_any_non_finite_number() {
        let good = Sample::resting(DeviceTime::ZERO, Pose::default());
        assert!(good.is_finite());
        for field in 0..4 {
            let mut bad = good;
            match field {
                0 => bad.pose.position.y = f64::NAN,
                1 => bad.velocity.z = f64::INFINITY,
                2 => bad.angular_velocity.x = f64::NAN,
                _ => bad.gripper = Some(f64::NAN),
            }
            assert!(!bad.is_finite(), "field {field}");
        }
        assert!(Wrench::ZERO.is_finite());
    }

    proptest! {
        #[test]
        fn a_uniform_motion_is_predicted(
            v in prop::array::uniform3(-0.5_f64..0.5),
            w in prop::array::uniform3(-5.0_f64..5.0),
            dt_s in 0.0_f64..0.05,
        ) {
            let mut sample = Sample::resting(DeviceTime::ZERO, Pose::default());
            (sample.velocity, sample.angular_velocity) = (v.into(), w.into());
            let at = sample.predicted_pose(dt_s);
            prop_assert!((at.position - sample.velocity * dt_s).norm() < 1e-12);
            let turned = at.orientation.scaled_axis() - sample.angular_velocity * dt_s;
            prop_assert!(turned.norm() < 1e-9);
        }

        #[test]
        fn a_glitch_of_the_velocity_is_bounded(v in -1e3_f64..1e3, w in -1e3_f64..1e3) {
            let mut sample = Sample::resting(DeviceTime::ZERO, Pose::default());
            (sample.velocity.x, sample.angular_velocity.y) = (v, w);
            let at = sample.predicted_pose(0.02);
            prop_assert!(at.position.norm() <= 0.02 + 1e-12);
            prop_assert!(at.orientation.angle() <= 0.2 + 1e-9);
        }
    }

    #[test]
    fn warm_motors_allow_force_and_an_emergency_stop_does_not() {
        assert!(!Faults::MOTORS_WARM.with(Faults::TIME_JUMP).forbid_force());
        assert!(
            Faults::MOTORS_WARM
                .with(Faults::EMERGENCY_STOP)
                .forbid_force()
        );
        assert!(
            Buttons::PRIMARY
                .with(Buttons::SECONDARY)
                .contains(Buttons::PRIMARY)
        );
    }
}
