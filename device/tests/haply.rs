//! The driver for the Inverse3, against a mock of its maker's service.

#![allow(clippy::unwrap_used)]

mod fake_haply;

use std::net::TcpListener;

use fake_haply::{Fake, Manners, Told};
use nalgebra::Vector3;
use palpate_device::backend::haply::{self, Haply, Service};
use palpate_device::conformance::{self, Hooks, Options, Outcome, Report, Row};
use palpate_device::{
    Buttons, Calibration, DeviceFault, DeviceTime, Faults, ForceState, HapticDevice, Sample, Wrench,
};

/// A device, its service, and a time that advances by a millisecond per message.
struct Bench {
    fake: Fake,
    device: Haply,
    ms: i64,
}

impl Bench {
    fn new(is_new: bool) -> Self {
        let fake = Fake::start(is_new, &["049D"]);
        let device = haply::open(&fake.service, None).unwrap();
        Self {
            fake,
            device,
            ms: 0,
        }
    }

    fn tick(&mut self, wrench: Wrench) -> Result<Sample, DeviceFault> {
        self.ms += 1;
        self.fake.answers();
        let now = DeviceTime::from_micros(self.ms * 1000);
        let sample = self.device.read(now);
        let _ = self.device.write(now, wrench);
        sample
    }

    /// Ticks until `is_seen`, for a second at most.
    fn until(&mut self, wrench: Wrench, is_seen: impl Fn(&Result<Sample, DeviceFault>) -> bool) {
        let seen = (0..1000).any(|_| {
            let sample = self.tick(wrench);
            is_seen(&sample)
        });
        assert!(seen, "never seen");
    }

    /// Pressed with 2 N to the right for half a second.
    fn pushed(is_new: bool) -> Self {
        let mut bench = Self::new(is_new);
        bench.device.enable_forces(true).unwrap();
        for _ in 0..500 {
            bench.tick(push()).unwrap();
        }
        assert_eq!(bench.fake.with(|t| t.force), [2.0, 0.0, 0.0]);
        bench
    }

    /// The last force that the service received, after a few more messages.
    fn force(&self) -> [f64; 3] {
        self.fake.hears(4);
        self.fake.with(|t| t.force)
    }
}

fn push() -> Wrench {
    Wrench::from_force(Vector3::new(2.0, 0.0, 0.0))
}

/// The suite's report on the driver, with a service that `is_told` changes after opening.
fn suite(is_new: bool, is_told: impl FnOnce(&mut Told)) -> Report {
    let Bench {
        fake,
        mut device,
        mut ms,
    } = Bench::new(is_new);
    fake.with(is_told);
    fake.hears(4);
    let mut clock = || {
        ms += 1;
        fake.answers();
        DeviceTime::from_micros(ms * 1000)
    };
    let mut unplug = || fake.with(|t| t.manners = Manners::WithoutDevice);
    let mut at_motors = || fake.with(|t| Vector3::from(t.force).norm());
    let mut amiss = || fake.with(|t| t.wrong.clone());
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
fn it_passes_the_suite_with_both_spellings_without_violations() {
    for is_new in [true, false] {
        let report = suite(is_new, |_| ());
        let rows = report.rows();
        assert!(
            rows.iter().all(|r| r.outcome == Outcome::Passed),
            "{report}"
        );
        assert_eq!(rows.len(), 13, "{report}");
    }
}

#[test]
fn the_suite_detects_faults_of_the_service() {
    type Tell = fn(&mut Told);
    let cases: [(Tell, &str); 7] = [
        (|t| t.manners = Manners::WithoutDevice, "poses are metres"),
        (|t| t.manners = Manners::HangsUp, "poses are metres"),
        (|t| t.unit = 1e3, "poses are metres"),
        (|t| t.calibrated = false, "enabling ramps"),
        (|t| t.way = |[x, y, z]| [y, x, z], "along its own axis"),
        (|t| t.way = |f| f.map(|n| n / 2.0), "motors get"),
        // From now on it expects the other spelling.
        (|t| t.is_new = false, "amiss"),
    ];
    for (i, (is_told, word)) in cases.into_iter().enumerate() {
        let report = suite(true, is_told);
        let is_broken = |r: &Row| matches!(r.outcome, Outcome::Failed(_)) && r.law.contains(word);
        assert!(report.rows().iter().any(is_broken), "case {i}: {report}");
    }
}

#[test]
fn poses_are_metres_in_the_frame_of_the_service_and_the_grip_turns_them() {
    let mut bench = Bench::pushed(true);
    for _ in 0..1000 {
        bench.tick(push()).unwrap();
    }
    let sample = bench.tick(push()).unwrap();
    let expected = Vector3::new(2.0 / 400.0, -0.12, 0.15);
    assert!(
        (sample.pose.position - expected).norm() < 1e-5,
        "{sample:?}"
    );
    assert_eq!(sample.buttons, Buttons::PRIMARY);
    assert_eq!(bench.device.caps().dof_in, 6);
}

#[test]
fn the_last_order_before_closing_is_zero() {
    let mut bench = Bench::pushed(false);
    bench.device.close();
    assert_eq!(
        bench.fake.with(|t| (t.force, t.wrong.clone())),
        ([0.0; 3], vec![])
    );
}

#[test]
fn a_stopped_loop_leaves_no_force() {
    let bench = Bench::pushed(true);
    bench.fake.hears(40);
    assert_eq!(bench.force(), [0.0; 3]);
}

#[test]
fn a_misbehaving_service_stops_the_force_and_a_good_one_restores_the_device() {
    for manners in [
        Manners::Silent,
        Manners::Garbage,
        Manners::NoState,
        Manners::NotANumber,
        Manners::Huge,
        Manners::Half,
        Manners::HangsUp,
        Manners::WithoutDevice,
    ] {
        let mut bench = Bench::pushed(true);
        bench.fake.with(|t| t.manners = manners);
        // First the force stops; then the device is gone.
        bench.until(push(), |s| match s {
            Ok(sample) => sample.faults.forbid_force(),
            Err(_) => true,
        });
        assert_eq!(bench.device.rendered(), Wrench::ZERO, "{manners:?}");
        bench.until(push(), |s| *s == Err(DeviceFault::Unplugged));
        assert_eq!(bench.device.force_state(), ForceState::Off, "{manners:?}");
        assert_eq!(
            bench.device.enable_forces(true),
            Err(DeviceFault::Unplugged),
            "{manners:?}"
        );
        let stands = bench.fake.with(|t| t.force != [0.0; 3]);
        // A closed connection carries no more orders; such a service releases the force by itself.
        let over = matches!(manners, Manners::HangsUp | Manners::Huge);
        assert!(!stands || over, "{manners:?} left a force standing");
        if manners == Manners::Half {
            // The rest of that message never arrives.
            continue;
        }
        bench.fake.with(|t| t.manners = Manners::Good);
        for _ in 0..200 {
            let _ = bench.tick(push());
        }
        bench.until(push(), Result::is_ok);
        assert_eq!(bench.device.enable_forces(true), Ok(()), "{manners:?}");
    }
}

#[test]
fn safety_events_are_faults_of_their_device() {
    let mut bench = Bench::pushed(true);
    bench.fake.event("04BA", "ebrake_triggered", "error");
    bench.fake.event("049D", "stall_detected", "warning");
    bench.until(push(), |s| s.unwrap().faults == Faults::OVER_FORCE);
    assert_eq!(
        bench.device.rendered().force.norm(),
        2.0,
        "the loop decides what it writes"
    );
    bench.until(push(), |s| s.unwrap().faults.is_empty());
    bench.fake.event("049D", "ebrake_triggered", "error");
    bench.until(push(), |s| s.unwrap().faults == Faults::EMERGENCY_STOP);
    bench.fake.event("049D", "ebrake_released", "notice");
    bench.until(push(), |s| s.unwrap().faults.is_empty());
}

#[test]
fn a_device_without_power_or_position_gets_no_force() {
    let mut bench = Bench::new(true);
    bench.fake.with(|t| t.powered = false);
    bench.fake.hears(4);
    bench.tick(push()).unwrap();
    assert_eq!(bench.device.enable_forces(true), Err(DeviceFault::NoPower));
    bench
        .fake
        .with(|t| (t.powered, t.calibrated) = (true, false));
    bench.fake.hears(4);
    let sample = bench.tick(push()).unwrap();
    assert!(sample.faults.contains(Faults::UNTRUSTED_POSE));
    assert_eq!(bench.device.calibrate(), Ok(Calibration::NeedsUser));
    assert_eq!(
        bench.device.enable_forces(true),
        Err(DeviceFault::NotCalibrated)
    );
}

#[test]
fn several_devices_are_listed_and_one_is_chosen_by_its_id() {
    let fake = Fake::start(true, &["049D", "04BA"]);
    let found = haply::find(&fake.service).unwrap();
    assert_eq!(found.len(), 2);
    let text = haply::open(&fake.service, None).unwrap_err().to_string();
    assert!(
        text.contains("049D") && text.contains("04BA") && text.contains("haply:049D"),
        "{text}"
    );
    let device = haply::open(&fake.service, Some("04ba")).unwrap();
    assert!(device.caps().name.contains("04BA"));
    drop(device);
    fake.with(|t| t.ids = vec!["049D", "049D"]);
    let alike = haply::open(&fake.service, Some("049D"))
        .unwrap_err()
        .to_string();
    assert!(alike.contains("unplug"), "{alike}");
    fake.with(|t| t.ids.clear());
    let none = haply::open(&fake.service, None).unwrap_err().to_string();
    assert!(none.contains("power supply"), "{none}");
}

#[test]
fn errors_of_the_service_are_one_sentence() {
    let at = |url: String| {
        let service = Service {
            simulation: url,
            events: None,
        };
        haply::open(&service, None).unwrap_err().to_string()
    };
    // A port that was free a moment ago.
    let free = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let absent = at(format!("ws://{free}"));
    assert!(absent.contains("haply.co"), "{absent}");
    let address = at("http://localhost".to_owned());
    assert!(address.contains("invalid address"), "{address}");
    let mute = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = at(format!("ws://{}", mute.local_addr().unwrap()));
    assert!(silent.contains("sends nothing"), "{silent}");
    let fake = Fake::start(true, &["049D"]);
    fake.with(|t| t.manners = Manners::Garbage);
    let other = haply::find(&fake.service).unwrap_err().to_string();
    assert!(other.contains("220 mail.example.org"), "{other}");
    fake.with(|t| t.manners = Manners::Silent);
    let silent = haply::find(&fake.service).unwrap_err().to_string();
    assert!(silent.contains("sends nothing"), "{silent}");
}
