//! What the haptic thread does in one turn: read, compute, write. No thread, no clock.
//!
//! The thread drives it with the machine's time, the laboratory with a virtual one, so that what is
//! tried with every fault there is, is what users run. Whatever happens, what the device renders
//! changes by no more than the chain's slew limit per turn, as far as it is ours to decide:
//!
//! - what the device clamps, refuses or takes away by itself is told to the chain, which goes on from
//!   what stands at the device and not from what it was asked for;
//! - a sample that is no number goes no further than the chain;
//! - a clock that is put back neither stops the device's time nor keeps an old force alive.

use palpate_device::{
    DeviceTime, Faults, ForceState, HapticDevice, Pose, Rejection, Sample, Wrench, Written,
};
use palpate_haptics::{Chain, ContactModel, Events, Tick};
use palpate_protocol::{ClientTime, Span};

use super::clock::device_time;

/// How often a device whose forces are off is asked to switch them on again: a board that failed once may be back, and
/// a device that was not calibrated may be now.
pub const ENABLE_EVERY: Span = Span::from_millis(1000);

/// After a stop is asked for, the ticks the force has to come down before the device is closed
/// all the same. The chain needs 100.
const STOP_TICKS_MAX: u32 = 150;

/// What a device renders is compared with what stood there to so many newtons.
const SAME_N: f64 = 1e-9;

/// One tick as others see it. It crosses threads whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// When the tick was, on the client's clock.
    pub time: ClientTime,
    /// What the device said; after a failed reading, or one that is no number, the last good sample,
    /// with [`Faults::UNTRUSTED_POSE`].
    pub sample: Sample,
    /// What was written to the device; zero for one that renders no force.
    pub wrench: Wrench,
    /// What the tissue does to the tool, for those who show it: see [`Tick::felt`].
    pub felt: Wrench,
    /// What happened.
    pub events: Events,
    /// Age of the contact model that was used.
    pub contact_age: Span,
}

impl Frame {
    /// Before the first tick.
    pub fn before(now: ClientTime) -> Self {
        Self {
            time: now,
            sample: Sample::resting(device_time(now), Pose::default()),
            wrench: Wrench::ZERO,
            felt: Wrench::ZERO,
            events: Events::NONE,
            contact_age: Span::ZERO,
        }
    }
}

/// What the rest of the program wants of the loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Wishes {
    /// The link to the session is lost: the force fades within 100 ms.
    pub link_lost: bool,
    /// The loop is to end: the force fades as when the link is lost.
    pub stop: bool,
}

/// What the loop met beside what the chain counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DeviceCounts {
    /// Times that the device could not be read, or its forces not be switched on.
    pub faults: u64,
    /// Wrenches that it clamped.
    pub saturated: u64,
    /// Wrenches that it refused while its forces were on; where they are off it refuses each one.
    pub rejected: u64,
    /// Times that it took its force away by itself, between two writes.
    pub cuts: u64,
    /// Times that the machine's clock was put back.
    pub clock_put_back: u64,
}

/// What a turn gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turned {
    /// The tick.
    pub frame: Frame,
    /// Whether its sample is one of this tick, and may go to others.
    pub is_good: bool,
    /// Whether a stop has done its work: the device can be closed.
    pub is_over: bool,
}

/// A device and its chain. The calling order: [`begin`](Self::begin), then
/// [`turn`](Self::turn) a thousand times a second, and [`close`](Self::close) at the end.
/// `turn` does not allocate, lock, log or wait.
pub struct HandLoop {
    device: Box<dyn HapticDevice>,
    chain: Chain,
    period: Span,
    last: Frame,
    link_is_lost: bool,
    ticks_to_stop: u32,
    /// How far the device's time is ahead of the machine's clock; more after every step back.
    ahead: Span,
    /// When forces may be asked for again, in the device's time.
    enable_at: DeviceTime,
    /// What the device rendered right after the last write.
    stands: Wrench,
    counts: DeviceCounts,
}

impl HandLoop {
    /// A loop of `period` that has not begun.
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

    /// What it met so far.
    pub fn counts(&self) -> DeviceCounts {
        self.counts
    }

    /// Switches the motors on.
    pub fn begin(&mut self) {
        if self.device.enable_forces(true).is_err() {
            self.counts.faults += 1;
        }
    }

    /// Writes zero and closes the device.
    pub fn close(&mut self) {
        self.device.close();
    }

    /// One turn at `now` on the client's clock, with the newest `model` of the tissue.
    pub fn turn(&mut self, now: ClientTime, wishes: Wishes, model: &ContactModel) -> Turned {
        let at = self.device_now(now);
        self.steer(now, wishes);
        let reading = self.device.read(at);
        self.notice_cut();
        let (tick, good) = match reading {
            Ok(sample) if self.forces_are_off() => {
                self.chain.cut_to(&Wrench::ZERO);
                self.enable_again(at);
                // The chain judges the sample, which goes to others, and makes no force of one with such a fault.
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
                ..last
            }),
            wrench: tick.wrench,
            felt: tick.felt,
            events: tick.events,
            contact_age: tick.contact_age,
        };
        Turned {
            frame: self.last,
            is_good: good.is_some(),
            is_over: wishes.stop && self.has_stopped(),
        }
    }

    /// `now` in the device's time, which goes on by a period where the machine's clock is put back:
    /// devices are promised that their time does not run backwards.
    fn device_now(&mut self, now: ClientTime) -> DeviceTime {
        let last = self.last.time;
        if now < last {
            self.counts.clock_put_back += 1;
            self.ahead += last + self.period - now;
        }
        device_time(now + self.ahead)
    }

    /// A stop fades the force as a lost link does.
    fn steer(&mut self, now: ClientTime, wishes: Wishes) {
        let lost = wishes.link_lost || wishes.stop;
        if lost && !self.link_is_lost {
            self.chain.link_lost(now);
        } else if !lost && self.link_is_lost {
            self.chain.link_restored(now);
        }
        self.link_is_lost = lost;
    }

    /// Sees whether the device has taken force away since the last write, as one with a watchdog of
    /// its own does while this program stands still. To go on from what was written then would be a blow.
    fn notice_cut(&mut self) {
        let there = self.device.rendered();
        let lost = self.stands.force.norm() - there.force.norm();
        let lost_nm = self.stands.torque.norm() - there.torque.norm();
        if lost > self.chain.slew_step_n() {
            self.counts.cuts += 1;
            self.chain.cut_to(&there);
        } else if lost > SAME_N || lost_nm > SAME_N {
            self.chain.goes_on_from(&there);
        }
    }

    fn forces_are_off(&self) -> bool {
        self.device.caps().dof_out > 0 && self.device.force_state() == ForceState::Off
    }

    /// While a driver brings its forces up, the soft start waits: the two together would be steeper than the slew limit.
    fn wait_for_ramp(&mut self) {
        if self.device.force_state() == ForceState::Ramping {
            self.chain.cut_to(&self.device.rendered());
        }
    }

    /// A device without motors is only told what the tool would feel.
    fn write(&mut self, at: DeviceTime, tick: &Tick) {
        if self.device.caps().dof_out == 0 {
            self.device.cue(at, &tick.felt);
            return;
        }
        match self.device.write(at, tick.wrench) {
            Written::Applied => {}
            Written::Saturated { applied } => {
                self.counts.saturated += 1;
                self.chain.goes_on_from(&applied);
            }
            Written::Rejected(why) => {
                self.counts.rejected += u64::from(why != Rejection::ForcesOff);
                self.chain.cut_to(&Wrench::ZERO);
            }
        }
        self.stands = self.device.rendered();
    }

    /// Asks for forces again, now and then. Until they are on the chain gives none, and its soft start begins after.
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

/// The sample, unless the chain found in this tick that it can not be.
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
        Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState,
        HapticDevice, Rejection, Sample, Script, Wrench, Written,
    };
    use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
    use palpate_protocol::{ClientTime, Span};

    use super::{HandLoop, Pose, Turned, Wishes};

    const MS: Span = Span::from_millis(1);

    /// What a device is told to do, and what it does.
    #[derive(Default)]
    struct Orders {
        refuses: bool,
        /// m, added to the place that it says.
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
        /// Two seconds into a contact of 6 N that somebody else presses against the tool.
        fn pressed() -> Self {
            let script = Script::resting_probe(Vector3::zeros(), 0.004).unwrap();
            let caps = SimHand::new(script, ScriptStart::not_yet()).caps().clone();
            let orders: Arc<Mutex<Orders>> = Arc::default();
            let chain = Chain::new(ChainConfig::default(), &caps);
            let device = Box::new(Obeying(caps, Arc::clone(&orders)));
            let us = 40_000_000;
            let hand = HandLoop::new(device, chain, MS, ClientTime::from_micros(us));
            let mut run = Self { hand, orders, us };
            run.hand.begin();
            for _ in 0..2000 {
                run.turn();
            }
            assert!((run.renders() - 6.0).abs() < 1e-9);
            run
        }

        fn turn(&mut self) -> Turned {
            self.us += 1000;
            let now = ClientTime::from_micros(self.us);
            let model = ContactModel {
                topology_version: 1,
                solved_at: now,
                others_j: self.us as f64 * 1e-6,
                radius: 0.05,
                ..ContactModel::single(Touch::at_pivot(
                    Vector3::new(0.0, 0.0, 6.0),
                    Matrix3::from_diagonal_element(300.0),
                    Vector3::z(),
                ))
            };
            self.hand.turn(now, Wishes::default(), &model)
        }

        fn renders(&self) -> f64 {
            self.orders.lock().unwrap().renders.force.z
        }

        /// The largest step that is rendered in so many turns.
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
    fn after_a_refused_write_the_force_comes_back_from_nothing() {
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
    fn a_device_whose_own_watchdog_has_cut_the_force_gets_no_blow_when_we_are_back() {
        let mut run = Run::pressed();
        run.us += 300_000;
        run.orders.lock().unwrap().renders = Wrench::ZERO;
        let step = run.largest_step(1300);
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
        assert!((run.renders() - 6.0).abs() < 1e-9, "{} N", run.renders());
        assert_eq!(run.hand.counts().cuts, 1);
    }

    #[test]
    fn a_pose_that_is_no_number_goes_no_further() {
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
    fn a_pose_that_can_not_be_goes_no_further_while_forces_are_off() {
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
    fn writes_while_forces_are_off_are_not_counted_as_refused_and_the_force_comes_back_slowly() {
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
    fn a_clock_that_is_put_back_is_not_passed_on_to_the_device() {
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
