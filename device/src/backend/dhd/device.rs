//! The driver as a [`HapticDevice`](crate::HapticDevice).

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::error::Code;
use super::models::caps;
use super::sys::Api;
use crate::motors::Motors;
use crate::{
    Buttons, Calibration, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice,
    Pose, Rejection, Sample, Wrench, Written,
};

/// Ramp time of the force after enabling, µs.
const RAMP_US: i64 = 200_000;

/// The angle of an open gripper, rad: 30 degrees for omega.7 and sigma.7.
const GRIPPER_OPEN_RAD: f64 = std::f64::consts::PI / 6.0;

/// Readings between two calibration checks: every tenth of a second.
const CALIBRATION_EVERY: u32 = 100;

/// An open device of Force Dimension, or a Falcon.
#[derive(Debug)]
pub struct Dhd {
    api: Api,
    caps: DeviceCaps,
    has_wrist: bool,
    has_gripper: bool,
    is_calibrated: bool,
    until_asked: u32,
    motors: Motors,
}

impl Dhd {
    /// The device that was opened last with this library.
    pub(super) fn new(api: Api) -> Self {
        let (has_wrist, has_gripper) = (api.has_wrist(), api.has_gripper());
        Self {
            caps: caps(api.system_type(), api.name(), has_wrist, has_gripper),
            has_wrist,
            has_gripper,
            is_calibrated: api.is_initialised(),
            until_asked: CALIBRATION_EVERY,
            motors: Motors::new(RAMP_US),
            api,
        }
    }

    /// Writes zero, then switches the motors off; tries both even if the first fails.
    fn stop(&mut self) -> Result<(), Code> {
        self.motors.stop();
        let zero = self.api.push(&Wrench::ZERO);
        self.api.enable(false).and(zero.map(|_| ()))
    }

    fn sense(&mut self, now: DeviceTime) -> Result<Sample, Code> {
        let position = self.api.position()?;
        let velocity = self.api.velocity()?;
        let (mut turn, mut turning) = (UnitQuaternion::identity(), Vector3::zeros());
        if self.has_wrist {
            turn = quaternion(self.api.turn()?);
            turning = self.api.turning()?;
        }
        let gripper = if self.has_gripper {
            Some((self.api.gripper()?.abs() / GRIPPER_OPEN_RAD).clamp(0.0, 1.0))
        } else {
            None
        };
        self.until_asked -= 1;
        if self.until_asked == 0 {
            self.until_asked = CALIBRATION_EVERY;
            self.is_calibrated = self.api.is_initialised();
        }
        let mut faults = Faults::NONE;
        if !self.is_calibrated {
            faults = faults.with(Faults::UNTRUSTED_POSE);
        }
        let frame = frame();
        let pose = Pose {
            position: frame * position,
            orientation: UnitQuaternion::from_rotation_matrix(&frame) * turn,
        };
        if !self.caps.workspace.contains(&pose.position) {
            faults = faults.with(Faults::OUT_OF_WORKSPACE);
        }
        Ok(Sample {
            time: now,
            pose,
            velocity: frame * velocity,
            angular_velocity: frame * turning,
            buttons: Buttons::from_bits(self.api.buttons()),
            gripper,
            faults,
        })
    }

    /// Renders the output of the motors, with the ramp; returns whether a motor is saturated.
    fn render(&self) -> Result<bool, Code> {
        let rendered = self.motors.rendered();
        let back = frame().inverse();
        self.api.push(&Wrench {
            force: back * rendered.force,
            torque: back * rendered.torque,
        })
    }
}

/// From the device's frame (x towards the user, y right, z up) to that of all drivers (x right, y away, z up).
fn frame() -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::new(
        0.0, 1.0, 0.0, //
        -1.0, 0.0, 0.0, //
        0.0, 0.0, 1.0,
    ))
}

fn quaternion(turn: Matrix3<f64>) -> UnitQuaternion<f64> {
    let turn = Rotation3::from_matrix_unchecked(turn);
    UnitQuaternion::new_normalize(UnitQuaternion::from_rotation_matrix(&turn).into_inner())
}

impl HapticDevice for Dhd {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        if self.is_calibrated {
            Calibration::Done
        } else {
            Calibration::NeedsUser
        }
    }

    /// Lets the device find its reference. It moves by itself for some seconds; keep hands off.
    fn calibrate(&mut self) -> Result<Calibration, DeviceFault> {
        self.motors.check_open()?;
        self.stop()?;
        let done = self.api.initialise();
        // The library's own control leaves the motors on.
        self.stop()?;
        self.is_calibrated = self.api.is_initialised();
        done?;
        Ok(self.calibration())
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.motors.check_open()?;
        self.stop()?;
        if on {
            self.is_calibrated = self.api.is_initialised();
            if !self.is_calibrated {
                return Err(DeviceFault::NotCalibrated);
            }
            self.api.enable(true)?;
            self.motors.enable(true)?;
        }
        Ok(())
    }

    fn force_state(&self) -> ForceState {
        self.motors.state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let now = self.motors.advance_to(now)?;
        match self.sense(now) {
            Ok(sample) if sample.is_finite() => Ok(sample),
            Ok(_) => {
                let _ = self.stop();
                Err(DeviceFault::Driver { code: 0 })
            }
            Err(code) => {
                // The error is already reported; stopping may also fail, because the device may be gone.
                let _ = self.stop();
                Err(code.into())
            }
        }
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        let taken = self.motors.take(now, wrench, &self.caps);
        let (applied, clamped) = match taken {
            Ok(taken) => taken,
            Err(why @ Rejection::NotFinite) => {
                let zero = self.render();
                return Written::Rejected(zero.err().map_or(why, Into::into));
            }
            Err(why) => return Written::Rejected(why),
        };
        match self.render() {
            // A saturated motor renders less, and the library does not report how much.
            Ok(limited) if clamped || limited => Written::Saturated { applied },
            Ok(_) => Written::Applied,
            Err(code) => {
                let _ = self.stop();
                Written::Rejected(code.into())
            }
        }
    }

    fn rendered(&self) -> Wrench {
        self.motors.rendered()
    }

    fn close(&mut self) {
        if self.motors.check_open().is_ok() {
            // A device that missed the first zero may take the second.
            if self.stop().is_err() {
                let _ = self.stop();
            }
            self.api.close();
            self.motors.close();
        }
    }
}

impl Drop for Dhd {
    fn drop(&mut self) {
        self.close();
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::frame;

    #[test]
    fn the_frame_maps_right_up_and_towards_the_user() {
        let frame = frame();
        assert_eq!(frame * Vector3::y(), Vector3::x());
        assert_eq!(frame * Vector3::z(), Vector3::z());
        assert_eq!(frame * Vector3::x(), -Vector3::y());
        assert!((frame.matrix().determinant() - 1.0).abs() < 1e-15);
    }
}
