//! State of the motors, common to all drivers: closed, off, ramp and limits.

use crate::clamp::{Ramp, clamp_wrench};
use crate::{DeviceCaps, DeviceFault, DeviceTime, ForceState, Rejection, Wrench};

/// A driver's motors as the trait reports them: off until enabled, zero until written, closed for good.
///
/// It limits the output and never accesses the hardware: the driver renders the results of [`take`](Self::take) and
/// [`rendered`](Self::rendered).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Motors {
    ramp_us: i64,
    ramp: Ramp,
    written: Wrench,
    /// The latest time passed to the device.
    now: DeviceTime,
    open: bool,
}

impl Motors {
    /// Motors of an open device, off; after enabling, forces ramp up over `ramp_us`, µs.
    pub(crate) const fn new(ramp_us: i64) -> Self {
        Self {
            ramp_us,
            ramp: Ramp::off(ramp_us),
            written: Wrench::ZERO,
            now: DeviceTime::from_micros(i64::MIN),
            open: true,
        }
    }

    /// Whether the device is open.
    pub(crate) const fn is_open(&self) -> bool {
        self.open
    }

    /// Whether the motors are off.
    pub(crate) const fn are_off(&self) -> bool {
        self.ramp.is_off()
    }

    /// The latest time passed to the device.
    pub(crate) const fn now(&self) -> DeviceTime {
        self.now
    }

    /// Advances the time to `now`, never backwards; an error after closing.
    pub(crate) fn advance_to(&mut self, now: DeviceTime) -> Result<DeviceTime, DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        self.now = now.max(self.now);
        Ok(self.now)
    }

    /// Switches on or off, starting from zero.
    pub(crate) fn enable(&mut self, on: bool) -> Result<(), DeviceFault> {
        if !self.open {
            return Err(DeviceFault::Closed);
        }
        self.stop();
        if on {
            self.ramp = Ramp::on(self.ramp_us);
        }
        Ok(())
    }

    /// Zero force, motors off.
    pub(crate) fn stop(&mut self) {
        self.ramp = Ramp::off(self.ramp_us);
        self.written = Wrench::ZERO;
    }

    /// Whether the motors may push.
    pub(crate) fn state(&self) -> ForceState {
        self.ramp.state(self.now)
    }

    /// Whether a write is accepted.
    pub(crate) fn ready(&self) -> Result<(), Rejection> {
        if !self.open {
            Err(Rejection::Closed)
        } else if self.are_off() {
            Err(Rejection::ForcesOff)
        } else {
            Ok(())
        }
    }

    /// Accepts a wrench written at `now`: returns its clamped value before the ramp, and whether it was clamped. A
    /// rejected wrench leaves zero.
    pub(crate) fn take(
        &mut self,
        now: DeviceTime,
        wrench: Wrench,
        caps: &DeviceCaps,
    ) -> Result<(Wrench, bool), Rejection> {
        self.ready()?;
        self.now = now.max(self.now);
        if !wrench.is_finite() {
            self.written = Wrench::ZERO;
            return Err(Rejection::NotFinite);
        }
        self.ramp.begin(self.now);
        let (within, clamped) = clamp_wrench(wrench, caps);
        self.written = within;
        Ok((within, clamped))
    }

    /// The driver renders only this wrench.
    pub(crate) fn render_only(&mut self, wrench: Wrench) {
        self.written = wrench;
    }

    /// The rendered wrench, with the ramp.
    pub(crate) fn rendered(&self) -> Wrench {
        self.written.scaled(self.gain())
    }

    /// The rendered fraction of a write, 0 to 1.
    pub(crate) fn gain(&self) -> f64 {
        self.ramp.gain(self.now)
    }

    /// Zero force, motors off, closed for good; returns whether it was open.
    pub(crate) fn close(&mut self) -> bool {
        self.stop();
        std::mem::replace(&mut self.open, false)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::Motors;
    use crate::backend::sim::{ScriptStart, SimHand};
    use crate::{
        DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice, Rejection, Script, Wrench,
    };

    fn caps() -> DeviceCaps {
        let script = Script::resting_probe(Vector3::zeros(), 4e-3).unwrap();
        SimHand::new(script, ScriptStart::not_yet()).caps().clone()
    }

    fn push(n: f64) -> Wrench {
        Wrench::from_force(Vector3::new(n, 0.0, 0.0))
    }

    #[test]
    fn a_rejected_wrench_leaves_zero() {
        let (caps, at) = (caps(), DeviceTime::from_micros);
        let mut motors = Motors::new(1000);
        assert_eq!(
            motors.take(at(0), push(1.0), &caps),
            Err(Rejection::ForcesOff)
        );
        motors.enable(true).unwrap();
        assert_eq!(motors.take(at(0), push(1.0), &caps), Ok((push(1.0), false)));
        assert_eq!(motors.rendered(), Wrench::ZERO);
        motors.advance_to(at(1000)).unwrap();
        assert_eq!(
            (motors.rendered(), motors.state()),
            (push(1.0), ForceState::On)
        );
        assert_eq!(
            motors.take(at(2000), push(f64::NAN), &caps),
            Err(Rejection::NotFinite)
        );
        assert_eq!(motors.rendered(), Wrench::ZERO);
        assert!(motors.close() && !motors.close());
        assert_eq!(
            motors.take(at(3000), push(1.0), &caps),
            Err(Rejection::Closed)
        );
        assert_eq!(motors.enable(true), Err(DeviceFault::Closed));
        assert_eq!(motors.advance_to(at(4000)), Err(DeviceFault::Closed));
    }

    proptest! {
        #[test]
        fn no_call_order_exceeds_the_limit_or_renders_with_motors_off(
            calls in prop::collection::vec((0..4_u8, -50.0..50.0_f64, 0..400_i64), 1..60),
        ) {
            let caps = caps();
            let mut motors = Motors::new(500);
            let mut us = 0;
            for (call, n, step) in calls {
                us += step;
                let now = DeviceTime::from_micros(us);
                match call {
                    0 => motors.enable(n > 0.0).unwrap(),
                    1 => motors.stop(),
                    2 => motors.advance_to(now).map(|_| ()).unwrap(),
                    _ => { let _ = motors.take(now, push(n), &caps); }
                }
                let rendered = motors.rendered().force.norm();
                prop_assert!(rendered <= caps.max_force_n * (1.0 + 1e-12));
                prop_assert!(!motors.are_off() || rendered == 0.0);
            }
        }
    }
}
