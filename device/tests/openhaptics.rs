//! The driver for Touch and Phantom, against a mock of their maker's library.

#![allow(clippy::unwrap_used)]

mod mock;

use std::sync::OnceLock;

use mock::Mock;
use nalgebra::Vector3;
use palpate_device::backend::openhaptics::{self, OpenHaptics};
use palpate_device::conformance::{self, Hooks, Options, Outcome, Report, Row};
use palpate_device::{
    Buttons, Calibration, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Wrench,
};

const RUNS_FREELY: u32 = 0;
const EACH_FRAME: u32 = 1;
const CALIBRATION: u32 = 3;
const INIT_ERROR: u32 = 4;
const NOT_A_NUMBER: u32 = 6;
const FLOODS: u32 = 7;
const STEP: u32 = 8;
const MICROMETRES: u32 = 9;
const SWAPS_AXES: u32 = 10;
const HALF_FORCE: u32 = 11;
const ERRORS_PER_FRAME: u32 = 12;
/// An unknown knob counts as a violation.
const UNKNOWN: u32 = 99;

/// Number of unread errors.
const ERRORS: u32 = 9;

/// Number of violations that the mock counted.
const WRONG: u32 = 0;

fn mock() -> Mock {
    static FIRST: OnceLock<Mock> = OnceLock::new();
    FIRST
        .get_or_init(|| Mock::compiled("hd.rs", "libHD.so", &[]))
        .copy()
}

/// An open device whose servo thread makes turns only on request.
fn open(mock: &Mock) -> OpenHaptics {
    let device = openhaptics::open(Some(&mock.file()), None).unwrap();
    mock.set(RUNS_FREELY, 0.0);
    device
}

fn at(ms: i64) -> DeviceTime {
    DeviceTime::from_micros(ms * 1000)
}

fn push(x: f64, y: f64, z: f64) -> Wrench {
    Wrench::from_force(Vector3::new(x, y, z))
}

fn force(mock: &Mock) -> Vector3<f64> {
    Vector3::new(mock.get(3), mock.get(4), mock.get(5))
}

fn wrongs(mock: &Mock) -> Vec<String> {
    mock.log()
        .into_iter()
        .filter(|l| l.starts_with("wrong"))
        .collect()
}

/// Writes `wrench` for the given milliseconds, with one turn of the servo thread each.
fn hold(device: &mut OpenHaptics, mock: &Mock, ms: std::ops::Range<i64>, wrench: Wrench) {
    for ms in ms {
        mock.set(STEP, 1.0);
        device.read(at(ms)).unwrap();
        let _ = device.write(at(ms), wrench);
    }
}

/// Closing waits for the servo thread, so that thread must run.
fn close(mut device: OpenHaptics, mock: &Mock) {
    mock.set(RUNS_FREELY, 1.0);
    device.close();
}

/// The suite's report on the driver with a mock whose knobs are set after opening.
fn suite(mock: &Mock, turn_knobs: impl Fn(&Mock)) -> Report {
    let mut device = open(mock);
    turn_knobs(mock);
    let mut ms = 0;
    let mut clock = || {
        ms += 1;
        mock.set(STEP, 1.0);
        at(ms)
    };
    let mut unplug = || mock.set(EACH_FRAME, f64::from(0x0302));
    let mut at_motors = || force(mock).norm();
    let mut amiss = || {
        let mut amiss = wrongs(mock);
        if mock.get(ERRORS) > 0.0 {
            amiss.push(format!("{} unread errors", mock.get(ERRORS)));
        }
        amiss
    };
    let hooks = Hooks {
        unplug: Some(&mut unplug),
        at_motors: Some(&mut at_motors),
        amiss: Some(&mut amiss),
    };
    let options = Options {
        moves_under_force: true,
    };
    conformance::run_with(&mut device, &mut clock, options, hooks)
}

#[test]
fn it_passes_the_suite_without_violations_at_the_library() {
    let report = suite(&mock(), |_| ());
    let rows = report.rows();
    assert!(
        rows.iter().all(|r| r.outcome == Outcome::Passed),
        "{report}"
    );
    assert_eq!(rows.len(), 13, "{report}");
}

#[test]
fn the_suite_detects_faults_of_the_library() {
    for (knob, value, word) in [
        (NOT_A_NUMBER, 1.0, "poses are metres"),
        (MICROMETRES, 1.0, "poses are metres"),
        (EACH_FRAME, f64::from(0x0302), "poses are metres"),
        (CALIBRATION, f64::from(0x5002), "enabling ramps"),
        (SWAPS_AXES, 1.0, "along its own axis"),
        (HALF_FORCE, 1.0, "motors get"),
        // More errors than the driver reads.
        (ERRORS_PER_FRAME, 100.0, "amiss"),
        (UNKNOWN, 0.0, "amiss"),
    ] {
        let mock = mock();
        let report = suite(&mock, |mock| {
            // The driver checks the calibration every hundred turns.
            mock.set(knob, value);
            mock.set(STEP, 101.0);
        });
        let is_broken = |r: &Row| matches!(r.outcome, Outcome::Failed(_)) && r.law.contains(word);
        assert!(report.rows().iter().any(is_broken), "knob {knob}: {report}");
    }
}

#[test]
fn closing_writes_zero_then_off_then_stops_scheduler_and_device() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.0, 0.0, 0.8));
    assert!((force(&mock) - Vector3::new(0.0, 0.8, 0.0)).norm() < 1e-12);
    close(device, &mock);
    let log = mock.log();
    let from = log.iter().rposition(|l| l == "zero").unwrap();
    assert_eq!(log[from..], ["zero", "off", "done", "off", "stop", "close"]);
    assert_eq!(
        (mock.get(WRONG), mock.get(6), mock.get(7), mock.get(8)),
        (0.0, 0.0, 0.0, 0.0)
    );
}

#[test]
fn closing_works_without_a_running_servo_thread() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.8, 0.0, 0.0));
    // It stops here.
    device.close();
    let log = mock.log();
    assert_eq!(
        log[log.len() - 5..],
        ["unschedule", "zero", "off", "stop", "close"]
    );
    assert_eq!(wrongs(&mock), Vec::<String>::new());
}

#[test]
fn forces_and_poses_are_in_one_frame_and_in_metres_and_newtons() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    // The force right, away from the user and up is x, minus z and y in the library's axes.
    hold(&mut device, &mock, 0..3000, push(0.4, 0.3, 0.2));
    assert!((force(&mock) - Vector3::new(0.4, 0.2, -0.3)).norm() < 1e-12);
    let sample = device.read(at(3000)).unwrap();
    assert!((sample.pose.position - Vector3::new(0.4, 0.3, 0.2) / 400.0).norm() < 1e-6);
    assert!((sample.angular_velocity - Vector3::new(0.1, -0.3, 0.2)).norm() < 1e-12);
    assert!((sample.pose.orientation * Vector3::x() - Vector3::y()).norm() < 1e-12);
    assert_eq!(sample.buttons, Buttons::PRIMARY);
    let caps = device.caps();
    assert_eq!((caps.max_force_n, caps.continuous_force_n), (3.3, 0.88));
    assert_eq!(caps.max_stiffness_n_per_m, 1020.0);
    assert!((caps.workspace.min - Vector3::new(-0.21, -0.13, -0.11)).norm() < 1e-12);
    close(device, &mock);
}

#[test]
fn a_stopped_loop_leaves_no_force() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.8, 0.0, 0.0));
    // The servo thread continues without writes of the loop.
    mock.set(STEP, 19.0);
    assert_eq!(force(&mock).x, 0.8);
    mock.set(STEP, 22.0);
    assert_eq!(force(&mock), Vector3::zeros());
    close(device, &mock);
}

#[test]
fn a_stopped_servo_thread_stops_the_force_and_then_reports_unplugged() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.8, 0.0, 0.0));
    let late = device.read(at(399 + 60)).unwrap();
    assert!(late.faults.contains(Faults::COMMUNICATION));
    assert_eq!(device.rendered(), Wrench::ZERO);
    assert_eq!(device.read(at(1000)), Err(DeviceFault::Unplugged));
    assert_eq!(device.force_state(), ForceState::Off);
    close(device, &mock);
    assert_eq!(wrongs(&mock), Vec::<String>::new());
}

#[test]
fn a_pulled_plug_removes_the_force_at_once_and_is_reported() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.0, 0.8, 0.0));
    mock.set(EACH_FRAME, f64::from(0x0302));
    mock.set(STEP, 2.0);
    assert_eq!(
        force(&mock),
        Vector3::zeros(),
        "the servo thread does not wait for the loop"
    );
    assert_eq!(device.read(at(401)), Err(DeviceFault::Unplugged));
    assert_eq!(device.enable_forces(true), Err(DeviceFault::Unplugged));
    mock.set(EACH_FRAME, 0.0);
    mock.set(STEP, 1.0);
    assert!(device.read(at(402)).is_ok());
    assert_eq!(device.enable_forces(true), Ok(()));
    close(device, &mock);
    assert_eq!(wrongs(&mock), Vec::<String>::new());
}

#[test]
fn errors_become_faults_and_are_all_read() {
    let mock = mock();
    let mut device = open(&mock);
    for (code, fault) in [
        (0x0200, Faults::MOTORS_WARM),
        (0x0201, Faults::OVER_FORCE),
        (0x0204, Faults::OVER_FORCE),
        (0x0402, Faults::COMMUNICATION),
    ] {
        mock.set(EACH_FRAME, f64::from(code));
        mock.set(STEP, 3.0);
        assert_eq!(device.read(at(1)).unwrap().faults, fault, "{code:#x}");
        assert_eq!(mock.get(9), 0.0, "{code:#x} was left in the list");
    }
    mock.set(EACH_FRAME, 0.0);
    // An endless list of errors does not block the turn.
    mock.set(FLOODS, 1.0);
    mock.set(STEP, 1.0);
    assert_eq!(device.read(at(2)).unwrap().faults, Faults::OVER_FORCE);
    mock.set(FLOODS, 0.0);
    mock.set(NOT_A_NUMBER, 1.0);
    mock.set(STEP, 1.0);
    assert!(matches!(
        device.read(at(3)),
        Err(DeviceFault::Driver { .. })
    ));
    close(device, &mock);
}

#[test]
fn unsupported_queries_do_not_stop_the_force() {
    let mock = mock();
    let mut device = open(&mock);
    mock.set(EACH_FRAME, f64::from(0x0100));
    device.enable_forces(true).unwrap();
    hold(&mut device, &mock, 0..400, push(0.8, 0.0, 0.0));
    assert_eq!(device.read(at(400)).unwrap().faults, Faults::NONE);
    assert_eq!(force(&mock).x, 0.8);
    close(device, &mock);
}

#[test]
fn an_uncalibrated_device_renders_no_force() {
    let mock = mock();
    mock.set(CALIBRATION, f64::from(0x5002));
    let mut device = openhaptics::open(Some(&mock.file()), None).unwrap();
    assert_eq!(device.calibration(), Calibration::NeedsUser);
    assert_eq!(device.enable_forces(true), Err(DeviceFault::NotCalibrated));
    assert!(
        device
            .read(at(0))
            .unwrap()
            .faults
            .contains(Faults::UNTRUSTED_POSE)
    );
    assert_eq!(device.calibrate(), Ok(Calibration::Done));
    assert!(mock.log().contains(&"calibrate 6".to_owned()));
    assert_eq!(device.enable_forces(true), Ok(()));
    device.close();
    assert_eq!(wrongs(&mock), Vec::<String>::new());
}

#[test]
fn a_device_is_opened_by_name_and_errors_contain_the_name() {
    let mock = mock();
    let found = openhaptics::find(Some(&mock.file()), Some("Left Device")).unwrap();
    assert_eq!(found.id, "Left Device");
    assert!(found.name.contains("Touch") && found.name.contains("20146700001"));
    assert!(mock.log().contains(&"init Left Device".to_owned()));
    assert_eq!(mock.get(8), 0.0, "it was left open");
    mock.set(INIT_ERROR, f64::from(0x0300));
    let refused = openhaptics::open(Some(&mock.file()), None)
        .unwrap_err()
        .to_string();
    assert!(
        refused.contains("Default Device") && refused.contains("0x0300"),
        "{refused}"
    );
    let bad = openhaptics::open(Some(&mock.file()), Some("a\0b"))
        .unwrap_err()
        .to_string();
    assert!(bad.contains("a\\0b"), "{bad}");
}

#[test]
fn errors_of_the_library_name_the_file() {
    if let Err(missing) = openhaptics::open(None, None) {
        let text = missing.to_string();
        assert!(
            text.contains("OpenHaptics") && text.contains("3D Systems"),
            "{text}"
        );
    }
    let old = Mock::compiled("hd.rs", "libHD-old.so", &["--cfg", "lacks_unschedule"]);
    let lacks = openhaptics::open(Some(&old.file()), None)
        .unwrap_err()
        .to_string();
    assert!(
        lacks.contains("libHD-old.so") && lacks.contains("hdUnschedule"),
        "{lacks}"
    );
}
