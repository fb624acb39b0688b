//! Replays a recorded motion, independent of forces.
//!
//! It serves comparisons: the same path against other tissues, solvers and networks. Forces are accepted, clamped
//! and kept for recording; they move nothing.

mod motion;
#[cfg(test)]
mod tests;

use crate::backend::sim::ScriptStart;
use crate::motors::Motors;
use crate::{
    DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Sample, Wrench, Written,
};

pub use motion::{Moment, Motion};

/// Ramp time of the force after enabling, µs.
const RAMP_US: i64 = 100_000;

/// The device that replays.
#[derive(Debug)]
pub struct Replay {
    caps: DeviceCaps,
    motion: Motion,
    start: ScriptStart,
    near: usize,
    motors: Motors,
}

impl Replay {
    /// Replays `motion` from `start` on, with the force limits of a desktop device: 20 N peak, 10 N continuous.
    pub fn new(motion: Motion, start: ScriptStart) -> Self {
        Self {
            caps: DeviceCaps::simulated("replayed motion"),
            motion,
            start,
            near: 0,
            motors: Motors::new(RAMP_US),
        }
    }
}

impl HapticDevice for Replay {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.motors.enable(on)
    }

    fn force_state(&self) -> ForceState {
        self.motors.state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let now = self.motors.advance_to(now)?;
        let t_s = self.start.script_s(now);
        let (moment, velocity, angular_velocity) = self.motion.at(t_s, &mut self.near);
        Ok(Sample {
            time: now,
            pose: moment.pose,
            velocity,
            angular_velocity,
            buttons: moment.buttons,
            gripper: None,
            faults: Faults::NONE,
        })
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        self.motors.write(now, wrench, &self.caps)
    }

    fn rendered(&self) -> Wrench {
        self.motors.rendered()
    }

    fn close(&mut self) {
        self.motors.close();
    }
}
