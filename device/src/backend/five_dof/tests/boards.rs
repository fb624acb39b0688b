//! Tests of the device on simulated boards: conformance, statics, and faults of the boards.

use std::sync::{Arc, Mutex};

use nalgebra::{UnitQuaternion, Vector3};

use super::super::rates::Rate;
use super::super::{Drive, Encoder, FiveDof, Port, PortFault, Rig, RigConfig, Six, invented};
use super::middle;
use crate::backend::sim::ScriptStart;
use crate::script::{Hand, Tool, Waypoint};
use crate::{
    Calibration, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Rejection, Sample,
    Script, Wrench, Written, conformance,
};

fn at(us: i64) -> DeviceTime {
    DeviceTime::from_micros(us)
}

fn script(turn: UnitQuaternion<f64>, to: Vector3<f64>) -> Script {
    let tool = Tool::probe(4e-3);
    let waypoints = vec![
        Waypoint::new(0.0, middle()).turned(turn),
        Waypoint::new(1.0, to).turned(turn).linear(),
    ];
    Script::new(tool, Hand::default(), waypoints, false).unwrap()
}

fn rig(script: Script) -> Rig {
    Rig::new(
        &invented(),
        RigConfig::default(),
        script,
        ScriptStart::at(at(0)),
    )
    .unwrap()
}

/// Boards whose counters are zero in any posture, as after power-on.
fn not_homed(mut rig: Rig) -> Rig {
    rig.offset = rig.true_counts().map(|c| -c);
    rig.homed = false;
    rig
}

/// Boards that fail while a fault is set.
struct Failing {
    rig: Rig,
    fault: Arc<Mutex<Option<PortFault>>>,
}

impl Failing {
    fn check(&self) -> Result<(), PortFault> {
        self.fault.lock().unwrap().map_or(Ok(()), Err)
    }
}

impl Port for Failing {
    fn counts(&mut self, now: DeviceTime) -> Result<Six, PortFault> {
        let counts = self.rig.counts(now)?;
        self.check().map(|()| counts)
    }
    fn command(&mut self, now: DeviceTime, codes: Six) -> Result<(), PortFault> {
        if let Err(fault) = self.check() {
            // Converters without their board output nothing.
            self.rig.command(now, [0; 6])?;
            return Err(fault);
        }
        self.rig.command(now, codes)
    }
    fn is_homed(&self) -> bool {
        self.rig.is_homed()
    }
    fn set_counts(&mut self, counts: Six) -> Result<(), PortFault> {
        self.check()?;
        self.rig.set_counts(counts)
    }
    fn close(&mut self) {
        self.rig.close();
    }
}

fn resting() -> FiveDof<Rig> {
    let rig = rig(script(UnitQuaternion::identity(), middle()));
    FiveDof::open(rig, invented()).unwrap()
}

/// Ticks at 1 kHz from `from` ms on; the last sample.
fn apply_wrench(device: &mut impl HapticDevice, from: i64, ticks: i64, wrench: Wrench) -> Sample {
    let mut last = None;
    for i in from..from + ticks {
        last = Some(device.read(at(i * 1000)).unwrap());
        let written = device.write(at(i * 1000), wrench);
        assert!(!matches!(written, Written::Rejected(_)), "{written:?}");
    }
    last.unwrap()
}

#[test]
fn it_passes_the_conformance_suite() {
    let mut us = 0;
    let mut clock = || {
        us += 1000;
        at(us)
    };
    let options = conformance::Options {
        moves_under_force: true,
    };
    let report = conformance::run(&mut resting(), &mut clock, options);
    assert!(report.passed(), "{report}");
}

#[test]
fn a_force_deflects_the_hands_spring_as_expected() {
    let mut device = resting();
    device.enable_forces(true).unwrap();
    for axis in 0..3 {
        let mut force = Vector3::zeros();
        force[axis] = 2.0;
        let wrench = Wrench::from_force(force);
        let from = 4000 * axis as i64;
        let sample = apply_wrench(&mut device, from, 4000, wrench);
        // With codes of 12 bits and quantised counts: 2 N against 400 N/m.
        let wrong = sample.pose.position - middle() - force / 400.0;
        assert!(wrong.norm() < 3e-4, "{wrong:?} m off along axis {axis}");
    }
}

#[test]
fn a_torque_turns_the_probe_except_about_its_axis() {
    let mut device = resting();
    device.enable_forces(true).unwrap();
    let torque = |torque| Wrench {
        force: Vector3::zeros(),
        torque,
    };
    let about_itself = torque(Vector3::y() * 0.08);
    let sample = apply_wrench(&mut device, 0, 2000, about_itself);
    assert!(sample.pose.orientation.angle() < 5e-3);
    let sample = apply_wrench(&mut device, 2000, 3000, torque(Vector3::x() * 0.08));
    // The grip is a spring of 0.5 N·m by the sine of the angle.
    let turn = sample.pose.orientation.scaled_axis();
    let expected = Vector3::x() * (0.08_f64 / 0.5).asin();
    assert!((turn - expected).norm() < 0.03, "{turn:?} rad");
}

#[test]
fn a_steady_motion_is_read_with_its_velocity() {
    let to = middle() + Vector3::new(0.02, -0.02, 0.03);
    let mut device =
        FiveDof::open(rig(script(UnitQuaternion::identity(), to)), invented()).unwrap();
    let speed = to - middle();
    for i in 0..900 {
        let sample = device.read(at(i * 1000)).unwrap();
        if i > 400 {
            // 41 mm/s turn the motors by 0.1 to 0.25 rad/s; over 31 ms a count is worth 0.025.
            let wrong = (sample.velocity - speed).norm() / speed.norm();
            assert!(wrong < 0.2, "{wrong} of the velocity at {i} ms");
            assert_eq!(sample.faults, Faults::NONE);
        }
    }
}

#[test]
fn a_tilted_probe_is_read_with_its_tilt() {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, 0.0, -0.2));
    let mut device = FiveDof::open(rig(script(turn, middle())), invented()).unwrap();
    for i in 0..200 {
        let sample = device.read(at(i * 1000)).unwrap();
        assert!(sample.pose.orientation.angle_to(&turn) < 0.03);
        assert!((sample.pose.position - middle()).norm() < 5e-4);
    }
}

#[test]
fn without_calibration_there_is_no_force() {
    let rig = not_homed(rig(script(UnitQuaternion::identity(), middle())));
    let mut device = FiveDof::open(rig, invented()).unwrap();
    assert_eq!(device.calibration(), Calibration::NeedsUser);
    let sample = device.read(at(0)).unwrap();
    assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
    assert_eq!(device.enable_forces(true), Err(DeviceFault::NotCalibrated));
    assert_eq!(device.force_state(), ForceState::Off);
    assert_eq!(device.calibrate(), Ok(Calibration::Done));
    let sample = device.read(at(1000)).unwrap();
    assert_eq!(sample.faults, Faults::NONE);
    assert!((sample.pose.position - middle()).norm() < 3e-4);
    assert_eq!(device.enable_forces(true), Ok(()));
}

#[test]
fn counts_that_contradict_each_other_are_a_fault() {
    let rig = not_homed(rig(script(UnitQuaternion::identity(), middle())));
    let mut device = FiveDof::open(rig, invented()).unwrap();
    // One counter that lost 200 counts of 0.8 mrad is 28 mm at the end of the arm.
    device.calibrate().unwrap();
    let mut skipping = FiveDof::open(Skipping(device), invented()).unwrap();
    let sample = skipping.read(at(0)).unwrap();
    assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
}

/// Boards of a device whose first counter has lost some counts.
struct Skipping(FiveDof<Rig>);

impl Port for Skipping {
    fn counts(&mut self, now: DeviceTime) -> Result<Six, PortFault> {
        self.0.read(now).unwrap();
        let encoder = Encoder::default();
        let q = self.0.angles;
        let mut counts: Six =
            std::array::from_fn(|j| (q[j / 3][j % 3] / encoder.step_rad()).round() as i32);
        counts[0] -= 200;
        Ok(counts)
    }
    fn command(&mut self, _now: DeviceTime, _codes: Six) -> Result<(), PortFault> {
        Ok(())
    }
    fn is_homed(&self) -> bool {
        true
    }
    fn set_counts(&mut self, _counts: Six) -> Result<(), PortFault> {
        Ok(())
    }
    fn close(&mut self) {}
}

#[test]
fn a_pulled_cable_stops_the_motors_and_is_reported() {
    let fault: Arc<Mutex<Option<PortFault>>> = Arc::default();
    let set = |now| *fault.lock().unwrap() = now;
    let boards = Failing {
        rig: rig(script(UnitQuaternion::identity(), middle())),
        fault: Arc::clone(&fault),
    };
    let mut device = FiveDof::open(boards, invented()).unwrap();
    device.enable_forces(true).unwrap();
    let push = Wrench::from_force(Vector3::x());
    apply_wrench(&mut device, 0, 500, push);
    set(Some(PortFault::Gone));
    assert_eq!(
        device.write(at(500_000), push),
        Written::Rejected(Rejection::Driver { code: -1 })
    );
    assert_eq!(device.read(at(501_000)), Err(DeviceFault::Unplugged));
    assert_eq!(device.force_state(), ForceState::Off);
    assert_eq!(device.rendered(), Wrench::ZERO);
    set(Some(PortFault::Board(7)));
    assert_eq!(
        device.read(at(502_000)),
        Err(DeviceFault::Driver { code: 7 })
    );
    // After replugging it is read, and stays without force until forces are enabled.
    set(None);
    assert!(device.read(at(503_000)).is_ok());
    assert_eq!(
        device.write(at(503_000), push),
        Written::Rejected(Rejection::ForcesOff)
    );
    assert!(device.port.rig.torque_nm.iter().all(|nm| *nm == 0.0));
}

#[test]
fn torques_beyond_the_motor_limit_are_reduced() {
    let mut weak = invented();
    weak.drive = Drive {
        torque_per_volt_nm: 0.02,
        limit_nm: 0.1,
        ..weak.drive
    };
    let rig = Rig::new(
        &weak,
        RigConfig::default(),
        script(UnitQuaternion::identity(), middle()),
        ScriptStart::not_yet(),
    )
    .unwrap();
    let mut device = FiveDof::open(rig, weak).unwrap();
    device.enable_forces(true).unwrap();
    device.read(at(0)).unwrap();
    let force = Vector3::new(1.0, 2.0, -3.0);
    let Written::Saturated { applied } = device.write(at(0), Wrench::from_force(force)) else {
        panic!("a tenth of a newton metre is not enough");
    };
    assert!(applied.force.cross(&force).norm() < 1e-9 && applied.force.norm() < force.norm());
}

#[test]
fn a_count_is_a_quarter_line_and_a_code_never_exceeds_the_torque() {
    let encoder = Encoder::default();
    assert_eq!(encoder.count(std::f64::consts::TAU + 1e-9), 8000);
    assert!((encoder.angle(2000) - std::f64::consts::FRAC_PI_2).abs() < 1e-15);
    let drive = invented().drive;
    for i in -3000..3000 {
        let nm = f64::from(i) * 1e-3;
        let given = drive.torque(drive.code(nm));
        assert!(given.abs() <= nm.abs().min(1.5) + 1e-12, "{given} of {nm}");
        assert!((given - nm.clamp(-1.5, 1.5)).abs() <= drive.step_nm());
    }
    assert_eq!(
        (drive.code(f64::NAN), drive.code(f64::INFINITY)),
        (0, drive.code(9.0))
    );
}

#[test]
fn rates_are_smooth_at_low_speed_and_prompt_at_high_speed() {
    let step = Encoder::default().step_rad();
    let read = |speed: f64, ms: i32| {
        let mut rate = Rate::new(step);
        let mut found = Vec::new();
        for i in 0..ms {
            let t = f64::from(i) * 1e-3;
            let angle = (speed * t / step).floor() * step;
            found.push(rate.read(t, angle));
        }
        found
    };
    for speed in [0.1, 0.5, 2.0] {
        let found = read(speed, 300);
        let worst = found[100..]
            .iter()
            .map(|r| (r - speed).abs())
            .fold(0.0, f64::max);
        // Over 31 ms a count is worth 25 mrad/s; a difference of two readings would be off by 0.79 rad/s.
        assert!(worst < 0.05, "{worst} rad/s at {speed}");
    }
    // A start from rest is seen within a few readings.
    let mut rate = Rate::new(step);
    for i in 0..100 {
        assert_eq!(rate.read(f64::from(i) * 1e-3, 0.0), 0.0);
    }
    let mut last = 0.0;
    for i in 100..105 {
        last = rate.read(f64::from(i) * 1e-3, f64::from(i - 99) * 4e-3);
    }
    assert!((last - 4.0).abs() < 0.8, "{last} rad/s");
    assert_eq!(rate.read(0.0, 1e9), last, "time does not run backwards");
}
