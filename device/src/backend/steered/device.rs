//! The driver as a [`HapticDevice`](crate::HapticDevice).

use nalgebra::Vector3;
use triple_buffer::Output;

use super::controls::{State, line};
use super::driver::{Driver, Hint};
use super::rumble::Shaker;
use super::{RateControl, Rumble, Source, Steering};
use crate::{
    DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, OpenError, Pose,
    Rejection, Sample, Workspace, Wrench, Written,
};

/// Workspace and initial pose of a tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Space {
    /// Reachable box.
    pub workspace: Workspace,
    /// Initial pose.
    pub start: Pose,
}

/// Properties of the kind of device.
#[derive(Debug, Clone, PartialEq)]
pub struct Kind {
    /// Name for the user.
    pub name: String,
    /// Degrees of freedom it senses.
    pub dof_in: u8,
    /// Silence after which a deflection counts as zero, µs, for devices that repeat themselves while they are held:
    /// the last message of a device out of reach must not move the tool on. `None` for those that send only
    /// changes.
    pub silence_max_us: Option<i64>,
    /// Map from deflection to speed.
    pub rate: RateControl,
    /// Map from force to rumble, for hardware with it.
    pub rumble: Option<Rumble>,
}

/// No device is connected; `what` is its kind.
#[cfg(any(feature = "gamepad", feature = "spacemouse"))]
pub(in crate::backend) fn not_found(what: &str) -> OpenError {
    OpenError::new(format_args!(
        "no {what} is connected; plug one in, or switch it on, and try again"
    ))
}

/// The library that lists the devices does not work here.
#[cfg(any(feature = "gamepad", feature = "spacemouse"))]
pub(in crate::backend) fn no_search(what: &str, why: impl std::fmt::Display) -> OpenError {
    OpenError::new(format_args!(
        "can not search for {what}s on this system: {why}"
    ))
}

/// A steered tool as a device. It senses and renders no force.
///
/// After a loss the driver looks for the device ([`REOPEN_EVERY`](super::REOPEN_EVERY)). Until it is back every
/// reading is [`DeviceFault::Unplugged`]; then the tool continues from its pose, at rest and with no button held.
#[derive(Debug)]
pub struct Steered {
    caps: DeviceCaps,
    steering: Steering,
    silence_max_us: Option<i64>,
    shaker: Option<Shaker>,
    states: Output<State>,
    hint: Hint,
    driver: Driver,
    heard: u64,
    heard_at: DeviceTime,
    garbled: u64,
    now: DeviceTime,
    open: bool,
}

impl Steered {
    /// Steers a tool in `space` by the controls of `source`; the source gets its own thread.
    pub fn open(source: Box<dyn Source>, kind: Kind, space: &Space) -> Result<Self, OpenError> {
        let steering = Steering::new(kind.rate, space.workspace, space.start)?;
        let (publisher, states) = line();
        let hint = Hint::default();
        let driver = Driver::spawn(source, publisher, hint.clone()).map_err(|e| {
            OpenError::new(format_args!(
                "the system did not start a thread for the device: {e}"
            ))
        })?;
        Ok(Self {
            caps: DeviceCaps::without_motors(kind.name, kind.dof_in, space.workspace),
            steering,
            silence_max_us: kind.silence_max_us,
            shaker: kind.rumble.map(Shaker::new),
            states,
            hint,
            driver,
            heard: 0,
            heard_at: DeviceTime::from_micros(i64::MIN),
            garbled: 0,
            now: DeviceTime::from_micros(i64::MIN),
            open: true,
        })
    }

    /// Number of invalid messages so far.
    pub fn garbled(&self) -> u64 {
        self.garbled
    }
}

impl HapticDevice for Steered {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn enable_forces(&mut self, _on: bool) -> Result<(), DeviceFault> {
        if self.open {
            Ok(())
        } else {
            Err(DeviceFault::Closed)
        }
    }

    fn force_state(&self) -> ForceState {
        ForceState::Off
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        self.now = now.max(self.now);
        let state = *self.states.read();
        if !state.present {
            self.steering.halt(self.now);
            return Err(DeviceFault::Unplugged);
        }
        if state.heard != self.heard {
            self.heard = state.heard;
            self.heard_at = self.now;
        }
        let silence = self.now.micros_since(self.heard_at);
        let (push, twist) = if self.silence_max_us.is_some_and(|max| silence > max) {
            (Vector3::zeros(), Vector3::zeros())
        } else {
            (state.controls.push, state.controls.twist)
        };
        let mut faults = self.steering.advance(self.now, &push, &twist);
        if state.garbled != self.garbled {
            self.garbled = state.garbled;
            faults = faults.with(Faults::COMMUNICATION);
        }
        Ok(Sample {
            time: self.now,
            pose: *self.steering.pose(),
            velocity: self.steering.velocity(),
            angular_velocity: self.steering.angular_velocity(),
            buttons: state.controls.buttons,
            gripper: state.controls.gripper,
            faults,
        })
    }

    fn write(&mut self, _now: DeviceTime, _wrench: Wrench) -> Written {
        Written::Rejected(if self.open {
            Rejection::NoMotors
        } else {
            Rejection::Closed
        })
    }

    fn cue(&mut self, now: DeviceTime, felt: &Wrench) {
        self.now = now.max(self.now);
        let strength = match &mut self.shaker {
            Some(shaker) if self.open => shaker.feel(self.now, felt),
            _ => None,
        };
        if let Some(strength) = strength {
            self.hint.set(strength as f32);
        }
    }

    fn rendered(&self) -> Wrench {
        Wrench::ZERO
    }

    fn close(&mut self) {
        self.open = false;
        self.driver.stop();
    }
}
