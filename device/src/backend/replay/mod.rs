//! A recorded motion, replayed: the hand goes its way whatever pushes it.
//!
//! It is for comparisons: the same path against other tissues, solvers and networks. Forces are taken, clamped and kept
//! for whoever records them; they move nothing.

mod motion;
#[cfg(test)]
mod tests;

use nalgebra::Vector3;

use crate::backend::sim::ScriptStart;
use crate::clamp::{Ramp, clamp_wrench};
use crate::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice,
    Rejection, Sample, Workspace, Wrench, Written,
};

pub use motion::{Moment, Motion, MotionError};

/// How long forces ramp up after they were enabled, µs.
const RAMP_US: i64 = 100_000;

/// The device that replays.
#[derive(Debug)]
pub struct Replay {
    caps: DeviceCaps,
    motion: Motion,
    start: ScriptStart,
    near: usize,
    ramp: Ramp,
    written: Wrench,
    now: DeviceTime,
    open: bool,
}

impl Replay {
    /// Replays `motion` from `start` on, with the force limits of a desktop device: 20 N for a moment, 10 N held.
    pub fn new(motion: Motion, start: ScriptStart) -> Self {
        let half = Vector3::repeat(crate::script::POSITION_MAX_M);
        Self {
            caps: DeviceCaps {
                name: "replayed motion".to_owned(),
                dof_in: 6,
                dof_out: 3,
                workspace: Workspace {
                    min: -half,
                    max: half,
                },
                max_force_n: 20.0,
                continuous_force_n: 10.0,
                max_torque_nm: 0.0,
                max_stiffness_n_per_m: 3000.0,
                rate_hz: 1000.0,
            },
            motion,
            start,
            near: 0,
            ramp: Ramp::off(RAMP_US),
            written: Wrench::ZERO,
            now: DeviceTime::from_micros(i64::MIN),
            open: true,
        }
    }
}

impl HapticDevice for Replay {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        Calibration::NotNeeded
    }

    fn clock(&self) -> ClockOwner {
        ClockOwner::Ours
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        self.written = Wrench::ZERO;
        self.ramp = if on {
            Ramp::on(RAMP_US)
        } else {
            Ramp::off(RAMP_US)
        };
        Ok(())
    }

    fn force_state(&self) -> ForceState {
        self.ramp.state(self.now)
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        self.now = now.max(self.now);
        let t_s = self.start.script_s(self.now);
        let (moment, velocity, angular_velocity) = self.motion.at(t_s, &mut self.near);
        Ok(Sample {
            time: self.now,
            pose: moment.pose,
            velocity,
            angular_velocity,
            buttons: moment.buttons,
            gripper: None,
            faults: Faults::NONE,
        })
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        if !self.open {
            return Written::Rejected(Rejection::Closed);
        }
        if self.ramp.is_off() {
            return Written::Rejected(Rejection::ForcesOff);
        }
        self.now = now.max(self.now);
        if !wrench.is_finite() {
            self.written = Wrench::ZERO;
            return Written::Rejected(Rejection::NotFinite);
        }
        self.ramp.begin(self.now);
        let (applied, clamped) = clamp_wrench(wrench, &self.caps);
        self.written = applied;
        if clamped {
            Written::Saturated { applied }
        } else {
            Written::Applied
        }
    }

    fn rendered(&self) -> Wrench {
        self.written.scaled(self.ramp.gain(self.now))
    }

    fn close(&mut self) {
        self.ramp = Ramp::off(RAMP_US);
        self.written = Wrench::ZERO;
        self.open = false;
    }
}
