//! A simulated hand: it follows a [`Script`] through a spring and responds to force.
//!
//! It needs no hardware and is always built. The same script, start and sequence of reads and writes give
//! bit-identical results.

mod body;
mod tremor;

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use self::body::Body;
pub(in crate::backend) use self::tremor::Tremor;
use crate::motors::Motors;
use crate::{
    Buttons, DeviceCaps, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Sample, Script,
    Wrench, Written,
};

/// Ramp time of the force after enabling, µs. It is short, because the haptic chain has its own soft start; it
/// exists so that users of the trait meet a driver with a ramp.
pub const ENABLE_RAMP_US: i64 = 100_000;

/// Maximum pause between two readings that is integrated, µs: 4000 sub-steps or about 0.2 ms of computing. After a
/// longer one the hand is placed on its script, with its velocity, and the sample carries [`Faults::TIME_JUMP`].
pub const CATCH_UP_MAX_US: i64 = 1_000_000;

/// Start time of a script, shared between the hand (on the real-time thread) and the thread that sets it later.
/// Until then the hand rests at the first way point and responds to force.
#[derive(Debug, Clone)]
pub struct ScriptStart(Arc<AtomicI64>);

impl ScriptStart {
    const NOT_YET: i64 = i64::MAX;

    /// An unknown start.
    pub fn not_yet() -> Self {
        Self(Arc::new(AtomicI64::new(Self::NOT_YET)))
    }

    /// A start at `at` on the clock the device is read with.
    pub fn at(at: DeviceTime) -> Self {
        Self(Arc::new(AtomicI64::new(at.as_micros())))
    }

    /// Lets the script begin at `at`. Setting it again moves the script, and the hand follows
    /// through its spring.
    pub fn set(&self, at: DeviceTime) {
        self.0.store(at.as_micros(), Ordering::Release);
    }

    /// Start time, if known.
    pub fn get(&self) -> Option<DeviceTime> {
        let us = self.0.load(Ordering::Acquire);
        (us != Self::NOT_YET).then(|| DeviceTime::from_micros(us))
    }

    /// Seconds of script at `now`; before the start 0 or less.
    pub(in crate::backend) fn script_s(&self, now: DeviceTime) -> f64 {
        self.get()
            .map_or(f64::NEG_INFINITY, |at| now.micros_since(at) as f64 * 1e-6)
    }
}

/// The simulated hand as a device.
#[derive(Debug)]
pub struct SimHand {
    caps: DeviceCaps,
    body: Body,
    start: ScriptStart,
    motors: Motors,
}

impl SimHand {
    /// A hand at the first way point of `script`, with the force limits of a desktop device: 20 N peak, 10 N
    /// continuous.
    pub fn new(script: Script, start: ScriptStart) -> Self {
        Self::with_caps(script, start, DeviceCaps::simulated("simulated hand"))
    }

    /// The same hand with other limits.
    pub fn with_caps(script: Script, start: ScriptStart, caps: DeviceCaps) -> Self {
        Self {
            caps,
            body: Body::new(script),
            start,
            motors: Motors::new(ENABLE_RAMP_US),
        }
    }

    /// The script it follows.
    pub fn script(&self) -> &Script {
        self.body.script()
    }

    /// Start time of its script; a clone of this sets it from another thread.
    pub fn start(&self) -> &ScriptStart {
        &self.start
    }

    /// Integrates the hand until now under the applied force.
    fn advance(&mut self) -> Faults {
        let (now, force) = (self.motors.now(), self.motors.rendered().force);
        self.body.advance(now, &self.start, force)
    }
}

impl HapticDevice for SimHand {
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
        let faults = self.advance();
        let script = self.body.script().pose(self.start.script_s(now));
        Ok(Sample {
            time: now,
            pose: crate::Pose {
                position: self.body.position_at(now),
                orientation: script.pose.orientation,
            },
            velocity: self.body.velocity(),
            angular_velocity: script.angular_velocity,
            buttons: if script.button {
                Buttons::PRIMARY
            } else {
                Buttons::NONE
            },
            gripper: None,
            faults,
        })
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        if let Err(why) = self.motors.ready() {
            return Written::Rejected(why);
        }
        // The old force acts until now. The next reading reports a jump of time.
        if self.motors.advance_to(now).is_ok() {
            self.advance();
        }
        self.motors.write(now, wrench, &self.caps)
    }

    fn rendered(&self) -> Wrench {
        self.motors.rendered()
    }

    fn close(&mut self) {
        self.motors.close();
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::{CATCH_UP_MAX_US, ScriptStart, SimHand};
    use crate::script::{Hand, Tool, Waypoint};
    use crate::{
        DeviceTime, Faults, ForceState, HapticDevice, Sample, Script, Wrench, Written, conformance,
    };

    fn press(tremor_m: f64) -> Script {
        let tool = Tool::probe(0.004);
        let waypoints = vec![
            Waypoint::new(0.0, Vector3::new(0.0, 0.0, 0.08)),
            Waypoint::new(1.0, Vector3::new(0.0, 0.0, 0.04)),
            Waypoint::new(2.0, Vector3::new(0.05, 0.0, 0.04)),
        ];
        Script::new(
            tool,
            Hand {
                tremor_m,
                ..Hand::default()
            },
            waypoints,
            false,
        )
        .unwrap()
    }

    fn at(us: i64) -> DeviceTime {
        DeviceTime::from_micros(us)
    }

    /// Ticks at 1 kHz against a wall of `k` N/m below z = 0.06 m; the last sample.
    fn against_wall(hand: &mut SimHand, k: f64, ticks: i64) -> Vec<Sample> {
        hand.enable_forces(true).unwrap();
        (0..ticks)
            .map(|i| {
                let sample = hand.read(at(i * 1000)).unwrap();
                let depth = (0.06 - sample.pose.position.z).max(0.0);
                let force = Wrench::from_force(Vector3::new(0.0, 0.0, k * depth));
                assert_eq!(hand.write(at(i * 1000), force), Written::Applied);
                sample
            })
            .collect()
    }

    #[test]
    fn it_passes_the_conformance_suite() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::not_yet());
        let mut us = 0;
        let mut clock = || {
            us += 1000;
            at(us)
        };
        let options = conformance::Options {
            moves_under_force: true,
        };
        let report = conformance::run(&mut hand, &mut clock, options);
        assert!(report.passed(), "{report}");
        assert!(
            report
                .rows()
                .iter()
                .all(|r| r.outcome == conformance::Outcome::Passed),
            "{report}"
        );
    }

    #[test]
    fn a_free_hand_follows_its_script_within_two_millimetres() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        let script = press(0.0);
        for sample in against_wall(&mut hand, 0.0, 3000) {
            let target = script.pose(sample.time.as_secs_f64()).pose.position;
            assert!((sample.pose.position - target).norm() < 2e-3);
        }
    }

    #[test]
    fn the_hand_rests_where_its_spring_and_our_force_balance() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        let last = against_wall(&mut hand, 400.0, 5000)[4999];
        // Two springs of 400 N/m, 20 mm apart: half way between.
        assert!((last.pose.position - Vector3::new(0.05, 0.0, 0.05)).norm() < 1e-6);
        assert!(last.velocity.norm() < 1e-6);
    }

    #[test]
    fn before_the_start_it_rests_at_the_first_way_point_and_responds_to_force() {
        let start = ScriptStart::not_yet();
        let mut hand = SimHand::new(press(0.0), start.clone());
        hand.enable_forces(true).unwrap();
        let mut last = hand.read(at(5_000_000)).unwrap();
        assert_eq!(last.pose.position, Vector3::new(0.0, 0.0, 0.08));
        for i in 1..2000 {
            last = hand.read(at(5_000_000 + i * 1000)).unwrap();
            let _ = hand.write(last.time, Wrench::from_force(Vector3::new(4.0, 0.0, 0.0)));
        }
        assert!((last.pose.position - Vector3::new(0.01, 0.0, 0.08)).norm() < 1e-5);
        start.set(at(7_000_000));
        for i in 2000..5000 {
            last = hand.read(at(5_000_000 + i * 1000)).unwrap();
        }
        assert!((last.pose.position - Vector3::new(0.06, 0.0, 0.04)).norm() < 1e-4);
    }

    #[test]
    fn the_same_reads_and_writes_give_the_same_bits() {
        let run = || {
            let mut hand = SimHand::new(press(0.000_3), ScriptStart::at(at(0)));
            against_wall(&mut hand, 500.0, 2500)
        };
        let bits = |s: &Sample| s.pose.position.map(f64::to_bits);
        assert!(run().iter().zip(&run()).all(|(a, b)| bits(a) == bits(b)));
    }

    #[test]
    fn the_times_of_reading_hardly_matter() {
        // The integration points do not depend on the readings.
        let mut often = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        let mut rarely = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        for us in (0..1_500_000).step_by(333) {
            often.read(at(us)).unwrap();
        }
        for us in (0..1_500_000).step_by(100_000) {
            rarely.read(at(us)).unwrap();
        }
        let (a, b) = (
            often.read(at(1_500_000)).unwrap(),
            rarely.read(at(1_500_000)).unwrap(),
        );
        assert_eq!(a.pose.position, b.pose.position);
    }

    #[test]
    fn after_a_long_pause_it_is_on_its_script_with_a_fault() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        assert_eq!(hand.read(at(0)).unwrap().faults, Faults::NONE);
        let after = hand.read(at(CATCH_UP_MAX_US + 500_000)).unwrap();
        assert!(after.faults.contains(Faults::TIME_JUMP));
        let target = press(0.0).pose(1.5);
        assert!((after.pose.position - target.pose.position).norm() < 1e-4);
        assert!((after.velocity - target.velocity).norm() < 1e-2);
        assert_eq!(
            hand.read(at(CATCH_UP_MAX_US + 501_000)).unwrap().faults,
            Faults::NONE
        );
    }

    #[test]
    fn time_that_runs_backwards_is_held() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        hand.read(at(1_000_000)).unwrap();
        let a = hand.read(at(1_400_000)).unwrap();
        let b = hand.read(at(0)).unwrap();
        assert_eq!((a.time, a.pose), (b.time, b.pose));
    }

    #[test]
    fn tremor_has_its_size_and_stays_in_its_band() {
        let mut hand = SimHand::new(press(0.000_5), ScriptStart::not_yet());
        let xs: Vec<f64> = (0..20_000)
            .map(|i| hand.read(at(i * 1000)).unwrap().pose.position.x)
            .skip(2000)
            .collect();
        let rms = (xs.iter().map(|x| x * x).sum::<f64>() / xs.len() as f64).sqrt();
        assert!((0.000_35..0.000_65).contains(&rms), "rms {rms}");
        let crossings = xs.windows(2).filter(|w| w[0] < 0.0 && w[1] >= 0.0).count();
        let hz = crossings as f64 / 18.0;
        assert!((7.5..12.5).contains(&hz), "{hz} Hz");
    }

    #[test]
    fn switching_forces_off_is_immediate() {
        let mut hand = SimHand::new(press(0.0), ScriptStart::at(at(0)));
        against_wall(&mut hand, 400.0, 3000);
        assert!(hand.rendered().force.norm() > 1.0);
        hand.enable_forces(false).unwrap();
        assert_eq!(
            (hand.rendered(), hand.force_state()),
            (Wrench::ZERO, ForceState::Off)
        );
    }
}
