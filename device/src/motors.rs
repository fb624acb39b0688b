//! State of the motors, common to all drivers: closed, off, ramp and limits.

use nalgebra::Vector3;

use crate::{DeviceCaps, DeviceFault, DeviceTime, ForceState, Rejection, Wrench, Written};

/// A driver's motors as the trait reports them: off until enabled, zero until written, closed for good.
///
/// It limits the output and never accesses the hardware: the driver renders the results of [`take`](Self::take) and
/// [`rendered`](Self::rendered).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Motors {
    /// Duration of the ramp after enabling, µs.
    ramp_us: i64,
    enabled: bool,
    /// The first write after enabling begins the ramp.
    ramp_from: Option<DeviceTime>,
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
            enabled: false,
            ramp_from: None,
            written: Wrench::ZERO,
            now: DeviceTime::from_micros(i64::MIN),
            open: true,
        }
    }

    /// Whether the motors are off.
    pub(crate) const fn are_off(&self) -> bool {
        !self.enabled
    }

    /// The latest time passed to the device.
    pub(crate) const fn now(&self) -> DeviceTime {
        self.now
    }

    /// An error after closing.
    pub(crate) const fn check_open(&self) -> Result<(), DeviceFault> {
        if self.open {
            Ok(())
        } else {
            Err(DeviceFault::Closed)
        }
    }

    /// Advances the time to `now`, never backwards; an error after closing.
    pub(crate) fn advance_to(&mut self, now: DeviceTime) -> Result<DeviceTime, DeviceFault> {
        self.check_open()?;
        self.now = now.max(self.now);
        Ok(self.now)
    }

    /// Switches on or off, starting from zero.
    pub(crate) fn enable(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.check_open()?;
        self.stop();
        self.enabled = on;
        Ok(())
    }

    /// Zero force, motors off.
    pub(crate) fn stop(&mut self) {
        self.enabled = false;
        self.ramp_from = None;
        self.written = Wrench::ZERO;
    }

    /// Whether the motors may push.
    pub(crate) fn state(&self) -> ForceState {
        if !self.enabled {
            ForceState::Off
        } else if self.gain() < 1.0 {
            ForceState::Ramping
        } else {
            ForceState::On
        }
    }

    /// Whether a write is accepted.
    pub(crate) fn ready(&self) -> Result<(), Rejection> {
        if !self.open {
            Err(Rejection::Closed)
        } else if self.enabled {
            Ok(())
        } else {
            Err(Rejection::ForcesOff)
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
        self.ramp_from.get_or_insert(self.now);
        let (within, clamped) = clamped(wrench, caps);
        self.written = within;
        Ok((within, clamped))
    }

    /// [`take`](Self::take) for a driver that renders every accepted wrench.
    pub(crate) fn write(&mut self, now: DeviceTime, wrench: Wrench, caps: &DeviceCaps) -> Written {
        match self.take(now, wrench, caps) {
            Ok((_, false)) => Written::Applied,
            Ok((applied, true)) => Written::Saturated { applied },
            Err(why) => Written::Rejected(why),
        }
    }

    pub(crate) fn render_only(&mut self, wrench: Wrench) {
        self.written = wrench;
    }

    /// The rendered wrench, with the ramp.
    pub(crate) fn rendered(&self) -> Wrench {
        self.written.scaled(self.gain())
    }

    /// The rendered fraction of a write, 0 to 1.
    pub(crate) fn gain(&self) -> f64 {
        self.ramp_from.map_or(0.0, |from| {
            (self.now.micros_since(from) as f64 / self.ramp_us as f64).clamp(0.0, 1.0)
        })
    }

    /// Zero force, motors off, closed for good; returns whether it was open.
    pub(crate) fn close(&mut self) -> bool {
        self.stop();
        std::mem::replace(&mut self.open, false)
    }
}

/// `wrench` clamped to the limits of a device, and whether it was changed. The directions are kept.
fn clamped(wrench: Wrench, caps: &DeviceCaps) -> (Wrench, bool) {
    let within = |v: Vector3<f64>, limit: f64| {
        let n = v.norm();
        if n > limit {
            (v * (limit / n), true)
        } else {
            (v, false)
        }
    };
    let (force, a) = within(wrench.force, caps.max_force_n);
    let (torque, b) = within(wrench.torque, caps.max_torque_nm);
    (Wrench { force, torque }, a || b)
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
