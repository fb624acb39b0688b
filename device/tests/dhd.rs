//! The driver for devices of Force Dimension and the Falcon, against a mock of their maker's library.

#![allow(clippy::unwrap_used)]

mod mock;

use std::path::Path;
use std::sync::OnceLock;

use mock::Mock;
use nalgebra::Vector3;
use palpate_device::backend::dhd::{self, Dhd};
use palpate_device::conformance::{self, Hooks, Options, Outcome, Report, Row};
use palpate_device::{
    Buttons, Calibration, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Rejection,
    Wrench, Written,
};

const DEVICES: u32 = 0;
const POSITION_ERROR: u32 = 1;
const FORCE_ERROR: u32 = 2;
const RETURNS: u32 = 3;
const INITIALISED: u32 = 4;
const NOT_A_NUMBER: u32 = 5;
const OPEN_ERROR: u32 = 6;
const SYSTEM_TYPE: u32 = 7;
const MILLIMETRES: u32 = 8;
const SWAPS_AXES: u32 = 9;
const HALF_FORCE: u32 = 10;
/// An unknown knob counts as a violation.
const UNKNOWN: u32 = 99;

/// Number of violations that the mock counted.
const WRONG: u32 = 0;

fn mock() -> Mock {
    static FIRST: OnceLock<Mock> = OnceLock::new();
    FIRST
        .get_or_init(|| Mock::compiled("drd.rs", "libdrd.so", &[]))
        .copy()
}

fn open(mock: &Mock) -> Dhd {
    dhd::open(Some(&mock.file()), None).unwrap()
}

fn at(ms: i64) -> DeviceTime {
    DeviceTime::from_micros(ms * 1000)
}

fn push(x: f64, y: f64, z: f64) -> Wrench {
    Wrench::from_force(Vector3::new(x, y, z))
}

fn force(mock: &Mock) -> [f64; 3] {
    [3, 4, 5].map(|i| mock.get(i))
}

/// Writes `wrench` for `ms` milliseconds from `from` on.
fn hold(device: &mut Dhd, from: i64, ms: i64, wrench: Wrench) {
    for i in 0..ms {
        device.read(at(from + i)).unwrap();
        let _ = device.write(at(from + i), wrench);
    }
}

/// The suite's report on the driver with a mock whose knobs are set.
fn suite(mock: &Mock) -> Report {
    let mut device = open(mock);
    let mut ms = 0;
    let mut clock = || {
        ms += 1;
        at(ms)
    };
    let mut unplug = || {
        mock.set(POSITION_ERROR, 2.0);
        mock.set(FORCE_ERROR, 2.0);
    };
    let mut at_motors = || Vector3::from(force(mock)).norm();
    let mut amiss = || {
        let log = mock.log().into_iter();
        log.filter(|l| l.starts_with("wrong")).collect::<Vec<_>>()
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
    let report = suite(&mock());
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
        (POSITION_ERROR, 2.0, "poses are metres"),
        (NOT_A_NUMBER, 1.0, "poses are metres"),
        (MILLIMETRES, 1.0, "poses are metres"),
        (INITIALISED, 0.0, "enabling ramps"),
        (FORCE_ERROR, 6.0, "enabling ramps"),
        (UNKNOWN, 0.0, "amiss"),
        (SWAPS_AXES, 1.0, "along its own axis"),
        (HALF_FORCE, 1.0, "motors get"),
    ] {
        let mock = mock();
        mock.set(knob, value);
        let report = suite(&mock);
        let is_broken = |r: &Row| matches!(r.outcome, Outcome::Failed(_)) && r.law.contains(word);
        assert!(report.rows().iter().any(is_broken), "knob {knob}: {report}");
    }
}

#[test]
fn the_motors_get_zero_and_are_off_before_the_device_is_closed() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, 0, 500, push(0.0, 0.0, 3.0));
    assert_eq!(force(&mock), [0.0, 0.0, 3.0]);
    drop(device);
    let log = mock.log();
    assert_eq!(log[log.len() - 3..], ["zero", "off", "close"]);
    assert_eq!(mock.get(WRONG), 0.0);
}

#[test]
fn forces_and_poses_are_in_one_frame_and_in_metres_and_newtons() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    // The force right and away from the user is y and minus x in the library's frame.
    hold(&mut device, 0, 3000, push(2.0, 1.0, 0.0));
    let [x, y, z] = force(&mock);
    assert!((x + 1.0).abs() < 1e-12 && (y - 2.0).abs() < 1e-12 && z.abs() < 1e-12);
    let sample = device.read(at(3000)).unwrap();
    let expected = Vector3::new(2.0, 1.0, 0.0) / 400.0;
    assert!((sample.pose.position - expected).norm() < 1e-6);
    assert!((sample.angular_velocity - Vector3::new(0.2, -0.1, 0.3)).norm() < 1e-12);
    // The stylus' own x axis, which the stand-in leaves towards the user.
    let axis = sample.pose.orientation * Vector3::x();
    assert!((axis + Vector3::y()).norm() < 1e-12);
    assert_eq!(sample.buttons, Buttons::SECONDARY);
    assert!((sample.gripper.unwrap() - 0.5).abs() < 1e-12);
}

#[test]
fn only_negative_results_are_errors() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    mock.set(RETURNS, 1.0);
    assert!(device.read(at(0)).is_ok());
    assert_eq!(device.write(at(0), push(1.0, 0.0, 0.0)), Written::Applied);
    mock.set(RETURNS, 2.0);
    assert!(matches!(
        device.write(at(1), push(1.0, 0.0, 0.0)),
        Written::Saturated { .. }
    ));
    mock.set(FORCE_ERROR, 6.0);
    let refused = device.write(at(2), push(1.0, 0.0, 0.0));
    assert_eq!(refused, Written::Rejected(Rejection::Driver { code: 6 }));
    assert_eq!(
        (device.force_state(), device.rendered()),
        (ForceState::Off, Wrench::ZERO)
    );
}

#[test]
fn a_pulled_plug_removes_the_force_and_is_reported() {
    let mock = mock();
    let mut device = open(&mock);
    device.enable_forces(true).unwrap();
    hold(&mut device, 0, 400, push(0.0, 2.0, 0.0));
    mock.set(POSITION_ERROR, 2.0);
    assert_eq!(device.read(at(400)), Err(DeviceFault::Unplugged));
    assert_eq!(
        (device.rendered(), device.force_state()),
        (Wrench::ZERO, ForceState::Off)
    );
    assert_eq!(force(&mock), [0.0; 3]);
    let written = device.write(at(401), push(0.0, 2.0, 0.0));
    assert_eq!(written, Written::Rejected(Rejection::ForcesOff));
    // After replugging, forces must be enabled again, and ramp.
    mock.set(POSITION_ERROR, 0.0);
    assert!(device.read(at(402)).is_ok());
    device.enable_forces(true).unwrap();
    let _ = device.write(at(403), push(0.0, 2.0, 0.0));
    assert_eq!(force(&mock), [0.0; 3]);
    mock.set(NOT_A_NUMBER, 1.0);
    assert!(matches!(
        device.read(at(404)),
        Err(DeviceFault::Driver { .. })
    ));
    assert_eq!(force(&mock), [0.0; 3]);
}

#[test]
fn an_uncalibrated_device_renders_no_force() {
    let mock = mock();
    mock.set(INITIALISED, 0.0);
    let mut device = open(&mock);
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
    assert_eq!(mock.get(6), 0.0, "its own control was left on");
    assert_eq!(device.read(at(1)).unwrap().faults, Faults::NONE);
    device.enable_forces(true).unwrap();
    // A later loss of calibration is detected within a tenth of a second.
    mock.set(INITIALISED, 0.0);
    let noticed = (2..103).any(|ms| {
        let sample = device.read(at(ms)).unwrap();
        sample.faults.contains(Faults::UNTRUSTED_POSE)
    });
    assert!(noticed);
}

#[test]
fn several_devices_are_listed_and_one_is_chosen_by_its_serial_number() {
    let mock = mock();
    mock.set(DEVICES, 2.0);
    let found = dhd::find(Some(&mock.file())).unwrap();
    assert_eq!(
        found.iter().map(|f| f.id.as_str()).collect::<Vec<_>>(),
        ["4000", "4001"]
    );
    let several = dhd::open(Some(&mock.file()), None).unwrap_err().to_string();
    assert!(
        several.contains("choose one") && several.contains("dhd:4000"),
        "{several}"
    );
    assert!(dhd::open(Some(&mock.file()), Some("4001")).is_ok());
    assert_eq!(
        mock.log().iter().rfind(|l| l.starts_with("open")).unwrap(),
        "open 1"
    );
    mock.set(DEVICES, 0.0);
    let none = dhd::open(Some(&mock.file()), None).unwrap_err().to_string();
    assert!(none.contains("no device of the kind dhd"), "{none}");
}

#[test]
fn a_device_in_use_is_reported() {
    let mock = mock();
    mock.set(OPEN_ERROR, 20.0);
    let refused = dhd::open(Some(&mock.file()), None).unwrap_err().to_string();
    assert!(
        refused.contains("communication error") && refused.contains("code 20"),
        "{refused}"
    );
}

#[test]
fn a_falcon_has_no_wrist_and_less_force() {
    let mock = mock();
    mock.set(SYSTEM_TYPE, 60.0);
    let mut device = open(&mock);
    let caps = device.caps();
    assert_eq!((caps.dof_in, caps.dof_out, caps.max_force_n), (3, 3, 8.0));
    assert_eq!(device.read(at(0)).unwrap().gripper, None);
}

#[test]
fn errors_of_the_library_name_the_file() {
    // By name: this machine has none.
    if let Err(missing) = dhd::open(None, None) {
        let text = missing.to_string();
        assert!(
            text.contains("libdrd") && text.contains("forcedimension.com"),
            "{text}"
        );
        assert!(!text.contains('\n'), "{text}");
    }
    let nowhere = dhd::open(Some(Path::new("nowhere/libdrd.so")), None).unwrap_err();
    assert!(nowhere.to_string().contains("can not be read"), "{nowhere}");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("libdrd.so");
    let mut elf = [0_u8; 64];
    elf[..6].copy_from_slice(b"\x7fELF\x02\x01");
    elf[18] = if cfg!(target_arch = "aarch64") {
        62
    } else {
        183
    };
    std::fs::write(&file, elf).unwrap();
    let other = dhd::open(Some(&file), None).unwrap_err().to_string();
    assert!(
        other.contains("libdrd.so") && other.contains(std::env::consts::ARCH),
        "{other}"
    );
    std::fs::write(&file, "not a library").unwrap();
    let refused = dhd::open(Some(&file), None).unwrap_err().to_string();
    assert!(
        refused.contains("libdrd.so") && refused.contains("can not be loaded"),
        "{refused}"
    );
    let old = Mock::compiled("drd.rs", "libdrd-old.so", &["--cfg", "lacks_buttons"]);
    let lacks = dhd::open(Some(&old.file()), None).unwrap_err().to_string();
    assert!(
        lacks.contains("libdrd-old.so") && lacks.contains("dhdGetButtonMask"),
        "{lacks}"
    );
}
