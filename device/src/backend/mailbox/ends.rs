//! The two ends of the link.

use nalgebra::{UnitQuaternion, Vector3};
use triple_buffer::{Input, Output, triple_buffer};

use super::{Fade, Share};
use crate::motors::Motors;
use crate::{
    Buttons, Calibration, DeviceCaps, DeviceFault, DeviceTime, Faults, Pose, Rejection, Sample,
    Wrench, Written,
};

/// A state older than this gives no force, µs.
const LATE_US: i64 = 50_000;

/// A device without a new state for so long counts as unplugged, µs.
const GONE_US: i64 = 500_000;

/// Ramp time of the force after enabling, µs.
const RAMP_US: i64 = 200_000;

/// Code of a write that was rejected because no state has arrived yet.
const NO_STATE: Rejection = Rejection::Driver { code: -1 };

/// The newest state of the device, from the driver's thread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::backend) struct DeviceState {
    /// m, in the frame of all drivers.
    pub(in crate::backend) pose: Pose,
    /// m/s.
    pub(in crate::backend) velocity: Vector3<f64>,
    /// rad/s.
    pub(in crate::backend) angular_velocity: Vector3<f64>,
    pub(in crate::backend) buttons: Buttons,
    pub(in crate::backend) faults: Faults,
    pub(in crate::backend) calibration: Calibration,
    /// Whether its motors have power.
    pub(in crate::backend) powered: bool,
    /// The rendered fraction of the loop's last order before the fade; see [`Share::since`] for later orders.
    pub(in crate::backend) share: Share,
    /// The driver knows that the device is gone.
    pub(in crate::backend) lost: Option<DeviceFault>,
}

impl DeviceState {
    /// The state of a device at rest in its origin.
    pub(in crate::backend) fn at_rest() -> Self {
        Self {
            pose: Pose {
                position: Vector3::zeros(),
                orientation: UnitQuaternion::identity(),
            },
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            buttons: Buttons::NONE,
            faults: Faults::NONE,
            calibration: Calibration::Done,
            powered: true,
            share: Share::FULL,
            lost: None,
        }
    }
}

/// The newest command of the loop to the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::backend) struct Order {
    /// The wrench to render, with ramp and limits applied.
    pub(in crate::backend) wrench: Wrench,
    /// Whether the motors may push.
    pub(in crate::backend) on: bool,
    /// The fraction that the loop already applied.
    known: Share,
}

impl Order {
    /// No force, and motors off.
    pub(in crate::backend) const OFF: Self = Self {
        wrench: Wrench::ZERO,
        on: false,
        known: Share::FULL,
    };
}

/// Creates the two ends. The driver's thread fades forces by `fade`.
pub(in crate::backend) fn mailbox(fade: Fade) -> (LoopEnd, DriverEnd) {
    let (state_in, state_out) = triple_buffer(&DeviceState::at_rest());
    let (orders_in, orders_out) = triple_buffer(&Order::OFF);
    let loop_end = LoopEnd {
        motors: Motors::new(RAMP_US),
        device_state: state_out,
        orders: orders_in,
        heard_at: None,
        known_share: Share::FULL,
        is_late: false,
    };
    let end = DriverEnd {
        device_state: state_in,
        orders: orders_out,
        fade,
    };
    (loop_end, end)
}

#[derive(Debug)]
pub(in crate::backend) struct DriverEnd {
    device_state: Input<DeviceState>,
    orders: Output<Order>,
    fade: Fade,
}

impl DriverEnd {
    pub(in crate::backend) fn publish(&mut self, device_state: DeviceState) {
        self.device_state.write(DeviceState {
            share: self.fade.share(),
            ..device_state
        });
    }

    /// The device got a zero force, or is gone: all earlier orders are void. The next state reports this to the
    /// loop.
    pub(in crate::backend) fn cut(&mut self) {
        self.orders.update();
        self.fade.cut();
    }

    /// The order to render in this turn; call once per turn.
    pub(in crate::backend) fn order(&mut self) -> Order {
        let is_renewed = self.orders.update();
        let newest = *self.orders.output_buffer();
        let part = self.fade.turn(is_renewed, newest.known);
        Order {
            wrench: newest.wrench.scaled(part),
            ..newest
        }
    }
}

/// The loop's end: the part of [`HapticDevice`](crate::HapticDevice) that does not depend on the device.
#[derive(Debug)]
pub(in crate::backend) struct LoopEnd {
    motors: Motors,
    device_state: Output<DeviceState>,
    orders: Input<Order>,
    heard_at: Option<DeviceTime>,
    /// The fraction known when the last wrench was written.
    known_share: Share,
    is_late: bool,
}

impl LoopEnd {
    /// The motors, as the trait reports them.
    pub(in crate::backend) fn motors(&self) -> &Motors {
        &self.motors
    }

    /// The rendered wrench by the newest state.
    pub(in crate::backend) fn rendered(&self) -> Wrench {
        let part = self.last().share.since(self.known_share);
        self.motors.rendered().scaled(part)
    }

    /// The newest state, and whether it is newer than that of the last call.
    pub(in crate::backend) fn receive(&mut self) -> (DeviceState, bool) {
        let is_new = self.device_state.update();
        (*self.device_state.output_buffer(), is_new)
    }

    pub(in crate::backend) fn last(&self) -> &DeviceState {
        self.device_state.output_buffer()
    }

    /// No force, motors off.
    pub(in crate::backend) fn halt(&mut self) {
        self.motors.stop();
        self.orders.write(Order::OFF);
    }

    /// Switches the motors.
    pub(in crate::backend) fn enable(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.motors.check_open()?;
        self.halt();
        if !on {
            return Ok(());
        }
        let (device_state, _) = self.receive();
        match device_state.lost {
            Some(why) => return Err(why),
            None if self.is_late => return Err(DeviceFault::Unplugged),
            None if !device_state.powered => return Err(DeviceFault::NoPower),
            None if !device_state.calibration.is_ready() => return Err(DeviceFault::NotCalibrated),
            None => {}
        }
        self.motors.enable(true)?;
        self.orders.write(Order {
            on: true,
            ..Order::OFF
        });
        Ok(())
    }

    /// The newest state as a sample, stamped by the first reading that received it.
    pub(in crate::backend) fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        let now = self.motors.advance_to(now)?;
        let (device_state, is_new) = self.receive();
        let heard_at = match self.heard_at {
            Some(at) if !is_new => at,
            _ => now,
        };
        self.heard_at = Some(heard_at);
        let age_us = now.micros_since(heard_at);
        self.is_late = age_us > LATE_US;
        if device_state.lost.is_some() || age_us > GONE_US {
            self.halt();
            return Err(device_state.lost.unwrap_or(DeviceFault::Unplugged));
        }
        let mut faults = device_state.faults;
        if self.is_late {
            faults = faults.with(Faults::COMMUNICATION);
        }
        if !device_state.calibration.is_ready() {
            faults = faults.with(Faults::UNTRUSTED_POSE);
        }
        if faults.forbid_force() && !self.motors.are_off() {
            self.motors.render_only(Wrench::ZERO);
            self.orders.write(Order {
                on: true,
                ..Order::OFF
            });
        }
        Ok(Sample {
            time: heard_at,
            pose: device_state.pose,
            velocity: device_state.velocity,
            angular_velocity: device_state.angular_velocity,
            buttons: device_state.buttons,
            gripper: None,
            faults,
        })
    }

    /// Publishes a wrench.
    pub(in crate::backend) fn write(
        &mut self,
        now: DeviceTime,
        wrench: Wrench,
        caps: &DeviceCaps,
    ) -> Written {
        let taken = self.motors.take(now, wrench, caps);
        let written = match taken {
            Ok(_) if self.is_late => {
                self.motors.render_only(Wrench::ZERO);
                Written::Rejected(NO_STATE)
            }
            Ok((_, false)) => Written::Applied,
            Ok((applied, true)) => Written::Saturated { applied },
            Err(why) => Written::Rejected(why),
        };
        if self.motors.ready().is_ok() {
            self.known_share = self.last().share;
            self.orders.write(Order {
                wrench: self.motors.rendered(),
                on: true,
                known: self.known_share,
            });
        }
        written
    }

    /// Zero force, motors off, for good; returns whether it was open.
    pub(in crate::backend) fn close(&mut self) -> bool {
        self.orders.write(Order::OFF);
        self.motors.close()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::{
        DeviceState, DriverEnd, Fade, GONE_US, LATE_US, LoopEnd, NO_STATE, Order, mailbox,
    };
    use crate::backend::sim::{ScriptStart, SimHand};
    use crate::{
        Calibration, DeviceCaps, DeviceFault, DeviceTime, Faults, HapticDevice, Script, Wrench,
        Written,
    };

    fn pushed() -> (LoopEnd, DriverEnd, DeviceCaps) {
        let script = Script::resting_probe(Vector3::zeros(), 4e-3).unwrap();
        let caps = SimHand::new(script, ScriptStart::not_yet()).caps().clone();
        let (mut loop_end, mut end) = mailbox(Fade::new(20, 20));
        loop_end.enable(true).unwrap();
        for ms in 0..300 {
            end.publish(DeviceState::at_rest());
            loop_end.read(at(ms * 1000)).unwrap();
            let _ = loop_end.write(at(ms * 1000), push(), &caps);
        }
        assert_eq!(end.order().wrench, push());
        (loop_end, end, caps)
    }

    fn at(us: i64) -> DeviceTime {
        DeviceTime::from_micros(us)
    }

    fn push() -> Wrench {
        Wrench::from_force(Vector3::new(0.0, 3.0, 0.0))
    }

    #[test]
    fn missing_states_stop_the_force_and_then_report_unplugged() {
        let (mut loop_end, mut end, caps) = pushed();
        let known = 299_000;
        assert!(
            loop_end
                .read(at(known + LATE_US))
                .unwrap()
                .faults
                .is_empty()
        );
        let late = loop_end.read(at(known + LATE_US + 1)).unwrap();
        assert!(late.faults.contains(Faults::COMMUNICATION));
        assert_eq!(late.time, at(known));
        let written = loop_end.write(at(known + LATE_US + 1), push(), &caps);
        assert_eq!(written, Written::Rejected(NO_STATE));
        assert_eq!(
            (loop_end.motors().rendered(), end.order().wrench),
            (Wrench::ZERO, Wrench::ZERO)
        );
        let gone = loop_end.read(at(known + GONE_US + 1));
        assert_eq!(gone, Err(DeviceFault::Unplugged));
        assert_eq!(end.order(), Order::OFF);
        assert_eq!(loop_end.enable(true), Err(DeviceFault::Unplugged));
        // The states arrive again.
        end.publish(DeviceState::at_rest());
        assert!(loop_end.read(at(known + GONE_US + 2000)).is_ok());
        assert_eq!(loop_end.enable(true), Ok(()));
    }

    #[test]
    fn a_device_lost_by_the_driver_is_reported_at_once() {
        let (mut loop_end, mut end, _) = pushed();
        end.publish(DeviceState {
            lost: Some(DeviceFault::Unplugged),
            ..DeviceState::at_rest()
        });
        assert_eq!(loop_end.read(at(300_000)), Err(DeviceFault::Unplugged));
        assert_eq!(end.order(), Order::OFF);
    }

    #[test]
    fn a_device_without_power_or_position_gets_no_force() {
        let (mut loop_end, mut end, _) = pushed();
        end.publish(DeviceState {
            powered: false,
            ..DeviceState::at_rest()
        });
        assert_eq!(loop_end.enable(true), Err(DeviceFault::NoPower));
        end.publish(DeviceState {
            calibration: Calibration::NeedsUser,
            ..DeviceState::at_rest()
        });
        assert_eq!(loop_end.enable(true), Err(DeviceFault::NotCalibrated));
        let sample = loop_end.read(at(300_000)).unwrap();
        assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
    }

    #[test]
    fn a_fault_removes_the_force_before_the_next_write() {
        let (mut loop_end, mut end, _) = pushed();
        end.publish(DeviceState {
            faults: Faults::EMERGENCY_STOP,
            ..DeviceState::at_rest()
        });
        loop_end.read(at(300_000)).unwrap();
        assert_eq!(
            (loop_end.motors().rendered(), end.order().wrench),
            (Wrench::ZERO, Wrench::ZERO)
        );
    }

    #[test]
    fn a_stopped_loop_leaves_no_force() {
        let (mut loop_end, mut end, _) = pushed();
        let forces: Vec<f64> = (0..60).map(|_| end.order().wrench.force.norm()).collect();
        assert!(forces[..15].iter().all(|n| *n == 3.0));
        assert!(forces[45..].iter().all(|n| *n == 0.0));
        assert!(forces.windows(2).all(|w| w[0] - w[1] < 0.16));
        // The loop gets this with the next state.
        assert_eq!(loop_end.rendered(), push());
        end.publish(DeviceState::at_rest());
        loop_end.read(at(301_000)).unwrap();
        assert_eq!(loop_end.rendered(), Wrench::ZERO);
    }

    #[test]
    fn an_order_from_before_a_cut_is_not_rendered() {
        let (mut loop_end, mut end, caps) = pushed();
        end.cut();
        assert!((0..30).all(|_| end.order().wrench == Wrench::ZERO));
        // Nor is an order of a loop that does not know of the cut.
        let _ = loop_end.write(at(300_000), push(), &caps);
        assert_eq!(end.order().wrench, Wrench::ZERO);
        // The loop learns of the cut and continues from zero; its next order is rendered.
        end.publish(DeviceState::at_rest());
        loop_end.read(at(301_000)).unwrap();
        assert_eq!(loop_end.rendered(), Wrench::ZERO);
        let step = push().scaled(0.2);
        let _ = loop_end.write(at(301_000), step, &caps);
        assert_eq!((loop_end.rendered(), end.order().wrench), (step, step));
    }

    #[test]
    fn an_order_that_contains_the_fade_is_not_faded_again() {
        let (mut loop_end, mut end, caps) = pushed();
        while end.order().wrench.force.norm() > 1.5 + 1e-9 {}
        end.publish(DeviceState::at_rest());
        loop_end.read(at(330_000)).unwrap();
        assert!((loop_end.rendered().force.norm() - 1.5).abs() < 1e-9);
        let less = push().scaled(0.3);
        let _ = loop_end.write(at(330_000), less, &caps);
        assert_eq!((loop_end.rendered(), end.order().wrench), (less, less));
    }

    /// A loop that continues from the rendered force, in steps of at most `STEP_N`.
    struct Loop {
        end: LoopEnd,
        caps: DeviceCaps,
        us: i64,
        /// N, along the push.
        stands: f64,
    }

    /// 600 N/s at 1 kHz.
    const STEP_N: f64 = 0.6;

    impl Loop {
        fn turn(&mut self, towards: f64) {
            // The step is short, so the last state stays valid: timeouts are tested elsewhere.
            self.us += 1;
            self.end.read(at(self.us)).unwrap();
            let there = self.end.rendered().force.y;
            self.stands = there + (towards - there).clamp(-STEP_N, STEP_N);
            let wrench = Wrench::from_force(Vector3::new(0.0, self.stands, 0.0));
            assert_eq!(
                self.end.write(at(self.us), wrench, &self.caps),
                Written::Applied
            );
        }
    }

    proptest! {
        #[test]
        fn the_rendered_force_changes_by_at_most_one_step_of_the_loop(
            turns in prop::collection::vec((0..3_u8, -3.0..3.0_f64, 1..30_u32), 1..60),
        ) {
            let (loop_end, mut end, caps) = pushed();
            let mut hand = Loop { end: loop_end, caps, us: 300_000, stands: 3.0 };
            let (mut before, mut orders) = (3.0, 0);
            let mut driver = |end: &mut DriverEnd, orders: &mut u32| {
                let now = end.order().wrench.force.y;
                let change = (now - before).abs();
                // Without a new order the force only fades.
                let is_fade = *orders == 0 && now.abs() <= f64::abs(before) && now * before >= 0.0;
                let is_step = change <= f64::from(*orders) * STEP_N + 1e-9;
                (before, *orders) = (now, 0);
                end.publish(DeviceState::at_rest());
                is_fade || is_step
            };
            for (who, towards, times) in turns {
                for _ in 0..times {
                    if who != 1 {
                        hand.turn(towards);
                        orders += 1;
                    }
                    if who != 2 {
                        prop_assert!(driver(&mut end, &mut orders));
                    }
                }
            }
        }
    }
}
