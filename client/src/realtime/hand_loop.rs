//! One tick of the haptic thread: read, compute, write. No thread, no clock.
//!
//! The haptic thread drives it with the machine's clock, tests with a virtual one, so fault tests run the production
//! code. As far as this program decides, the rendered force changes by at most the slew-rate limit per tick:
//!
//! - the chain continues from the force that the device renders, even if the device clamped, refused or dropped the
//!   requested force;
//! - a NaN sample stops at the chain;
//! - a clock that is set back neither stops the device's time nor keeps an old force alive.

use nalgebra::Vector3;
use palpate_device::{
    Buttons, DeviceTime, Faults, ForceState, HapticDevice, Pose, Rejection, Sample, Wrench, Written,
};
use palpate_haptics::{Chain, ContactModel, Events, Tick};
use palpate_protocol::tool::INSERTED_BUTTON;
use palpate_protocol::{ClientTime, LocalSample, Span};

use super::clock::device_time;

/// Retry period for enabling forces: a failed board may have recovered, and a device may have been calibrated.
pub const ENABLE_EVERY: Span = Span::from_millis(1000);

/// Ticks after a stop until the device is closed even under force. The chain needs 100 to fade it.
const STOP_TICKS_MAX: u32 = 150;

/// Tolerance when comparing the rendered with the written force, N.
const SAME_N: f64 = 1e-9;

/// One tick as seen by other threads; it is passed as a whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Time of the tick, on the client's clock.
    pub time: ClientTime,
    /// Sample of the device. After a failed or NaN reading it is the last good sample, at rest and with
    /// [`Faults::UNTRUSTED_POSE`].
    pub sample: Sample,
    /// Whether the device has given a good sample yet. Until then `sample` is no pose of it.
    pub is_measured: bool,
    /// Wrench written to the device; zero for one that renders no force.
    pub wrench: Wrench,
    /// Contact force on the tool, for display: see [`Tick::felt`].
    pub felt: Wrench,
    /// From the device to the proxy, m, for display: see [`Tick::proxy_offset`].
    pub proxy_offset: Vector3<f64>,
    /// Events of the tick.
    pub events: Events,
    /// Age of the contact model in use.
    pub contact_age: Span,
    /// Whether the tool is a needle in the tissue.
    pub is_inserted: bool,
}

impl Frame {
    /// The frame before the first tick.
    pub fn before(now: ClientTime) -> Self {
        Self {
            time: now,
            sample: Sample::resting(device_time(now), Pose::default()),
            is_measured: false,
            wrench: Wrench::ZERO,
            felt: Wrench::ZERO,
            proxy_offset: Vector3::zeros(),
            events: Events::NONE,
            contact_age: Span::ZERO,
            is_inserted: false,
        }
    }

    /// The buttons of the tool as in a protocol sample.
    pub fn tool_buttons(&self) -> u8 {
        tool_buttons(self.sample.buttons, self.is_inserted)
    }
}

/// Buttons of a device and the state of its tool as in a protocol sample, which holds seven buttons.
pub fn tool_buttons(buttons: Buttons, is_inserted: bool) -> u8 {
    let held = buttons.bits() as u8 & !INSERTED_BUTTON;
    held | if is_inserted { INSERTED_BUTTON } else { 0 }
}

/// A tick of the force loop as a protocol sample.
pub fn local_sample(frame: &Frame) -> LocalSample {
    let q = frame.sample.pose.orientation;
    LocalSample {
        time: frame.time,
        pose: palpate_protocol::Pose {
            position_m: frame.sample.pose.position.into(),
            orientation: [q.i, q.j, q.k, q.w],
        },
        buttons: frame.tool_buttons(),
        force_n: Some(frame.wrench.force.into()),
    }
}

/// Commands of the program to the loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LoopCommands {
    /// The link to the session is lost: the force fades within 100 ms.
    pub link_lost: bool,
    /// Stop the loop: the force fades as after a lost link.
    pub stop: bool,
}

/// Device events, in addition to the counters of the chain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DeviceCounts {
    /// Failures to read the device or to enable its forces.
    pub faults: u64,
    /// Wrenches clamped by the device.
    pub saturated: u64,
    /// Wrenches rejected by the device while its forces were on. With forces off it rejects all of them.
    pub rejected: u64,
    /// Times that the device dropped its force between two writes.
    pub cuts: u64,
    /// Times that the machine's clock was set back.
    pub clock_put_back: u64,
}

/// Result of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turned {
    /// Data of the tick.
    pub frame: Frame,
    /// Whether the sample is new, and may go to other participants.
    pub is_good: bool,
    /// Whether the force has faded after a stop: the device can be closed.
    pub is_over: bool,
}

/// A device and its haptic chain. Calling order: [`begin`](Self::begin), then [`turn`](Self::turn) a thousand times a
/// second, and [`close`](Self::close) at the end. `turn` does not allocate, lock, log or wait.
pub struct HandLoop {
    device: Box<dyn HapticDevice>,
    chain: Chain,
    period: Span,
    last: Frame,
    link_is_lost: bool,
    ticks_to_stop: u32,
    /// Offset of the device's time from the machine's clock; it grows each time the clock is set back.
    ahead: Span,
    /// Earliest time to enable forces again, in the device's time.
    enable_at: DeviceTime,
    /// Wrench rendered right after the last write.
    stands: Wrench,
    counts: DeviceCounts,
}

impl HandLoop {
    /// A loop of `period` that has not started.
    pub fn new(device: Box<dyn HapticDevice>, chain: Chain, period: Span, now: ClientTime) -> Self {
        Self {
            device,
            chain,
            period,
            last: Frame::before(now),
            link_is_lost: false,
            ticks_to_stop: STOP_TICKS_MAX,
            ahead: Span::ZERO,
            enable_at: device_time(now),
            stands: Wrench::ZERO,
            counts: DeviceCounts::default(),
        }
    }

    /// The chain.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// Device events so far.
    pub fn counts(&self) -> DeviceCounts {
        self.counts
    }

    /// Enables the forces.
    pub fn begin(&mut self) {
        if self.device.enable_forces(true).is_err() {
            self.counts.faults += 1;
        }
    }

    /// Writes zero and closes the device.
    pub fn close(&mut self) {
        self.device.close();
    }

    /// One tick at `now` on the client's clock, with the newest contact `model`.
    pub fn turn(
        &mut self,
        now: ClientTime,
        loop_commands: LoopCommands,
        model: &ContactModel,
    ) -> Turned {
        let at = self.device_now(now);
        self.steer(now, loop_commands);
        let reading = self.device.read(at);
        self.notice_cut();
        let (tick, good) = match reading {
            Ok(sample) if self.forces_are_off() => {
                self.chain.restart_from(&Wrench::ZERO);
                self.enable_again(at);
                // The chain checks this sample and renders no force for it.
                let faults = sample.faults.with(Faults::UNTRUSTED_POSE);
                let tick = self.chain.tick(now, &Sample { faults, ..sample }, model);
                (tick, judged(&tick, sample))
            }
            Ok(sample) => {
                self.wait_for_ramp();
                let tick = self.chain.tick(now, &sample, model);
                (tick, judged(&tick, sample))
            }
            Err(_) => {
                self.counts.faults += 1;
                (self.chain.tick_without_sample(now), None)
            }
        };
        self.write(at, &tick);
        let last = self.last.sample;
        self.last = Frame {
            time: now,
            sample: good.unwrap_or(Sample {
                faults: last.faults.with(Faults::UNTRUSTED_POSE),
                velocity: Vector3::zeros(),
                angular_velocity: Vector3::zeros(),
                ..last
            }),
            is_measured: good.is_some() || self.last.is_measured,
            wrench: tick.wrench,
            felt: tick.felt,
            proxy_offset: tick.proxy_offset,
            events: tick.events,
            contact_age: tick.contact_age,
            // A rejected model does not withdraw the needle.
            is_inserted: if model.is_usable() {
                model.is_inserted
            } else {
                self.last.is_inserted
            },
        };
        Turned {
            frame: self.last,
            is_good: good.is_some(),
            is_over: loop_commands.stop && self.has_stopped(),
        }
    }

    /// `now` in the device's time. It advances by one period if the machine's clock is set back, because device time
    /// must not run backwards.
    fn device_now(&mut self, now: ClientTime) -> DeviceTime {
        let last = self.last.time;
        if now < last {
            self.counts.clock_put_back += 1;
            self.ahead += last + self.period - now;
        }
        device_time(now + self.ahead)
    }

    /// A stop fades the force like a lost link.
    fn steer(&mut self, now: ClientTime, loop_commands: LoopCommands) {
        let lost = loop_commands.link_lost || loop_commands.stop;
        if lost && !self.link_is_lost {
            self.chain.link_lost(now);
        } else if !lost && self.link_is_lost {
            self.chain.link_restored(now);
        }
        self.link_is_lost = lost;
    }

    /// Detects a force that the device dropped since the last write, for example by its own watchdog while this
    /// program stalled. Continuing from the written force would give a force jump.
    fn notice_cut(&mut self) {
        let there = self.device.rendered();
        let lost = self.stands.force.norm() - there.force.norm();
        let lost_nm = self.stands.torque.norm() - there.torque.norm();
        if lost > self.chain.slew_step_n() {
            self.counts.cuts += 1;
            self.chain.restart_from(&there);
        } else if lost > SAME_N || lost_nm > SAME_N {
            self.chain.continue_from(&there);
        }
    }

    fn forces_are_off(&self) -> bool {
        self.device.caps().dof_out > 0 && self.device.force_state() == ForceState::Off
    }

    /// The soft start waits while a driver ramps up its forces: both ramps together would exceed the slew-rate limit.
    fn wait_for_ramp(&mut self) {
        if self.device.force_state() == ForceState::Ramping {
            self.chain.restart_from(&self.device.rendered());
        }
    }

    /// A device without motors receives the contact force for display only.
    fn write(&mut self, at: DeviceTime, tick: &Tick) {
        if self.device.caps().dof_out == 0 {
            self.device.cue(at, &tick.felt);
            return;
        }
        match self.device.write(at, tick.wrench) {
            Written::Applied => {}
            Written::Saturated { applied } => {
                self.counts.saturated += 1;
                self.chain.continue_from(&applied);
            }
            Written::Rejected(why) => {
                self.counts.rejected += u64::from(why != Rejection::ForcesOff);
                self.chain.restart_from(&Wrench::ZERO);
            }
        }
        self.stands = self.device.rendered();
    }

    /// Retries to enable forces. Until then the chain renders none, and its soft start begins afterwards.
    fn enable_again(&mut self, at: DeviceTime) {
        if at >= self.enable_at {
            self.enable_at = at.plus_micros(ENABLE_EVERY.as_micros());
            if self.device.enable_forces(true).is_err() {
                self.counts.faults += 1;
            }
        }
    }

    fn has_stopped(&mut self) -> bool {
        self.ticks_to_stop = self.ticks_to_stop.saturating_sub(1);
        self.ticks_to_stop == 0 || self.last.wrench == Wrench::ZERO
    }
}

/// The sample, unless the chain rejected it in this tick.
fn judged(tick: &Tick, sample: Sample) -> Option<Sample> {
    let is_bad = tick.events.contains(Events::BAD_SAMPLE);
    (!is_bad).then_some(sample)
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use nalgebra::{Matrix3, Vector3};
    use palpate_device::backend::sim::{ScriptStart, SimHand};
    use palpate_device::{
        Buttons, Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState,
        HapticDevice, Rejection, Sample, Script, Wrench, Written,
    };
    use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
    use palpate_protocol::tool::INSERTED_BUTTON;
    use palpate_protocol::{ClientTime, Span};

    use super::{HandLoop, LoopCommands, Pose, Turned, local_sample, tool_buttons};

    const MS: Span = Span::from_millis(1);

    /// Commands to the test device, and its observed state.
    #[derive(Default)]
    struct Orders {
        refuses: bool,
        /// Offset added to the reported position, m.
        astray: f64,
        is_off: bool,
        renders: Wrench,
        told: Vec<DeviceTime>,
    }

    struct Obeying(DeviceCaps, Arc<Mutex<Orders>>);

    impl HapticDevice for Obeying {
        fn caps(&self) -> &DeviceCaps {
            &self.0
        }
        fn calibration(&self) -> Calibration {
            Calibration::NotNeeded
        }
        fn clock(&self) -> ClockOwner {
            ClockOwner::Ours
        }
        fn enable_forces(&mut self, _on: bool) -> Result<(), DeviceFault> {
            Ok(())
        }
        fn force_state(&self) -> ForceState {
            if self.1.lock().unwrap().is_off {
                return ForceState::Off;
            }
            ForceState::On
        }
        fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
            let mut orders = self.1.lock().unwrap();
            orders.told.push(now);
            let mut sample = Sample::resting(now, Pose::default());
            sample.pose.position.x += orders.astray;
            Ok(sample)
        }
        fn write(&mut self, _now: DeviceTime, wrench: Wrench) -> Written {
            let mut orders = self.1.lock().unwrap();
            if orders.is_off {
                orders.renders = Wrench::ZERO;
                return Written::Rejected(Rejection::ForcesOff);
            }
            if orders.refuses {
                orders.renders = Wrench::ZERO;
                return Written::Rejected(Rejection::Driver { code: 1 });
            }
            orders.renders = wrench;
            Written::Applied
        }
        fn rendered(&self) -> Wrench {
            self.1.lock().unwrap().renders
        }
        fn close(&mut self) {}
    }

    struct Run {
        hand: HandLoop,
        orders: Arc<Mutex<Orders>>,
        us: i64,
    }

    impl Run {
        fn new() -> Self {
            let script = Script::resting_probe(Vector3::zeros(), 0.004).unwrap();
            let caps = SimHand::new(script, ScriptStart::not_yet()).caps().clone();
            let orders: Arc<Mutex<Orders>> = Arc::default();
            let chain = Chain::new(ChainConfig::default(), &caps);
            let device = Box::new(Obeying(caps, Arc::clone(&orders)));
            let us = 40_000_000;
            let hand = HandLoop::new(device, chain, MS, ClientTime::from_micros(us));
            let mut run = Self { hand, orders, us };
            run.hand.begin();
            run
        }

        /// Two seconds into a contact of 6 N that another tool presses against this one.
        fn pressed() -> Self {
            let mut run = Self::new();
            for _ in 0..2000 {
                run.turn();
            }
            assert!((run.renders() - 6.0).abs() < 1e-9);
            run
        }

        fn turn(&mut self) -> Turned {
            self.turn_with(|_| ())
        }

        fn turn_with(&mut self, change: impl Fn(&mut ContactModel)) -> Turned {
            self.us += 1000;
            let now = ClientTime::from_micros(self.us);
            let mut model = ContactModel {
                topology_version: 1,
                solved_at: now,
                external_work_j: self.us as f64 * 1e-6,
                radius: 0.05,
                ..ContactModel::single(Touch::at_pivot(
                    Vector3::new(0.0, 0.0, 6.0),
                    Matrix3::from_diagonal_element(300.0),
                    Vector3::z(),
                ))
            };
            change(&mut model);
            self.hand.turn(now, LoopCommands::default(), &model)
        }

        fn renders(&self) -> f64 {
            self.orders.lock().unwrap().renders.force.z
        }

        /// The largest rendered force step within this number of ticks.
        fn largest_step(&mut self, turns: usize) -> f64 {
            let mut largest = 0.0_f64;
            for _ in 0..turns {
                let before = self.renders();
                self.turn();
                largest = largest.max((self.renders() - before).abs());
            }
            largest
        }
    }

    #[test]
    fn samples_carry_the_insertion_of_the_needle_and_a_rejected_model_does_not_withdraw_it() {
        let mut run = Run::pressed();
        let buttons = |turned: Turned| local_sample(&turned.frame).buttons;
        assert_eq!(buttons(run.turn()), 0);
        assert_eq!(
            buttons(run.turn_with(|model| model.is_inserted = true)),
            INSERTED_BUTTON
        );
        let rejected = run.turn_with(|model| model.couple.x = f64::NAN);
        assert_eq!(buttons(rejected), INSERTED_BUTTON);
        assert_eq!(buttons(run.turn()), 0);
        // The device has no say in it.
        assert_eq!(tool_buttons(Buttons::from_bits(0x1ff), false), 0x7f);
    }

    #[test]
    fn force_restarts_from_zero_after_rejected_write() {
        let mut run = Run::pressed();
        run.orders.lock().unwrap().refuses = true;
        run.turn();
        run.orders.lock().unwrap().refuses = false;
        assert_eq!(run.renders(), 0.0);
        let step = run.largest_step(1200);
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
        assert!((run.renders() - 6.0).abs() < 1e-9, "{} N", run.renders());
        assert_eq!(run.hand.counts().rejected, 1);
    }

    #[test]
    fn device_watchdog_cut_is_followed_by_soft_start() {
        let mut run = Run::pressed();
        run.us += 300_000;
        run.orders.lock().unwrap().renders = Wrench::ZERO;
        let step = run.largest_step(1300);
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
        assert!((run.renders() - 6.0).abs() < 1e-9, "{} N", run.renders());
        assert_eq!(run.hand.counts().cuts, 1);
    }

    #[test]
    fn frame_is_measured_from_the_first_good_pose_on() {
        let mut run = Run::new();
        run.orders.lock().unwrap().astray = f64::NAN;
        assert!(!run.turn().frame.is_measured);
        run.orders.lock().unwrap().astray = 0.0;
        assert!(run.turn().frame.is_measured);
        run.orders.lock().unwrap().astray = f64::NAN;
        assert!(run.turn().frame.is_measured);
    }

    #[test]
    fn nan_pose_is_rejected() {
        let mut run = Run::pressed();
        run.orders.lock().unwrap().astray = f64::NAN;
        let turned = run.turn();
        let sample = turned.frame.sample;
        assert!(!turned.is_good && sample.is_finite());
        assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
        run.orders.lock().unwrap().astray = 0.0;
        let turned = run.turn();
        assert!(turned.is_good && turned.frame.sample.faults == Faults::NONE);
    }

    #[test]
    fn impossible_pose_is_rejected_with_forces_off() {
        let mut run = Run::pressed();
        run.orders.lock().unwrap().is_off = true;
        assert!(run.turn().is_good);
        run.orders.lock().unwrap().astray = 2e3;
        let turned = run.turn();
        let sample = turned.frame.sample;
        assert!(!turned.is_good && sample.pose.position.x == 0.0);
        assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
        run.orders.lock().unwrap().astray = 0.0;
        let turned = run.turn();
        assert!(turned.is_good && turned.frame.sample.faults == Faults::NONE);
    }

    #[test]
    fn writes_with_forces_off_are_not_counted_and_force_returns_slowly() {
        let mut run = Run::pressed();
        run.orders.lock().unwrap().is_off = true;
        for _ in 0..500 {
            run.turn();
        }
        run.orders.lock().unwrap().is_off = false;
        let step = run.largest_step(1200);
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
        assert!((run.renders() - 6.0).abs() < 1e-9, "{} N", run.renders());
        assert_eq!(run.hand.counts().rejected, 0);
    }

    #[test]
    fn device_time_is_monotonic_when_clock_is_set_back() {
        let mut run = Run::pressed();
        run.us -= 5_000_000;
        let step = run.largest_step(500);
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
        assert!((run.renders() - 6.0).abs() < 1e-9, "{} N", run.renders());
        let orders = run.orders.lock().unwrap();
        assert!(
            orders
                .told
                .windows(2)
                .all(|w| w[1].micros_since(w[0]) == 1000)
        );
        assert_eq!(run.hand.counts().clock_put_back, 1);
    }
}
