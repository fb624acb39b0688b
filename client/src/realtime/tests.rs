//! Tests of the whole thread. They assert no timing, because the machine may be busy.

#![allow(clippy::unwrap_used)]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use nalgebra::{Matrix3, Vector3};
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice, Pose,
    Sample, Script, Wrench, Written,
};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};

use super::{Frame, HapticHandle, HapticPorts, RealtimeConfig, monotonic_now, spawn};

/// Observations of a test device.
#[derive(Default)]
struct Diary {
    written: Vec<Wrench>,
    closed: bool,
    written_after_close: bool,
}

/// A device at rest at the origin that fails on command.
struct Watched {
    caps: DeviceCaps,
    clock: ClockOwner,
    forces: ForceState,
    reads: u64,
    fails_at: std::ops::Range<u64>,
    panics_at: Option<u64>,
    diary: Arc<Mutex<Diary>>,
}

impl Watched {
    fn new() -> (Self, Arc<Mutex<Diary>>) {
        let script = Script::resting_probe(Vector3::zeros(), 0.004).unwrap();
        let caps = SimHand::new(script, ScriptStart::not_yet()).caps().clone();
        let diary = Arc::default();
        let watched = Self {
            caps,
            clock: ClockOwner::Ours,
            forces: ForceState::Off,
            reads: 0,
            fails_at: 0..0,
            panics_at: None,
            diary: Arc::clone(&diary),
        };
        (watched, diary)
    }
}

impl HapticDevice for Watched {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }
    fn calibration(&self) -> Calibration {
        Calibration::NotNeeded
    }
    fn clock(&self) -> ClockOwner {
        self.clock
    }
    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        self.forces = if on { ForceState::On } else { ForceState::Off };
        Ok(())
    }
    fn force_state(&self) -> ForceState {
        self.forces
    }
    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        self.reads += 1;
        assert!(self.panics_at != Some(self.reads), "the driver's own bug");
        if self.fails_at.contains(&self.reads) {
            // Like a driver: a failed board gives no force until it is enabled again.
            self.forces = ForceState::Off;
            return Err(DeviceFault::Unplugged);
        }
        Ok(Sample::resting(now, Pose::default()))
    }
    fn write(&mut self, _now: DeviceTime, wrench: Wrench) -> Written {
        let mut diary = self.diary.lock().unwrap();
        diary.written_after_close |= diary.closed;
        diary.written.push(wrench);
        Written::Applied
    }
    fn rendered(&self) -> Wrench {
        Wrench::ZERO
    }
    fn close(&mut self) {
        self.diary.lock().unwrap().closed = true;
    }
}

/// A current contact of 3 N from another tool, with a power of 1 W.
fn contact() -> ContactModel {
    let now = monotonic_now();
    ContactModel {
        topology_version: 1,
        solved_at: now,
        external_work_j: now.as_micros() as f64 * 1e-6,
        radius: 0.05,
        ..ContactModel::single(Touch::at_pivot(
            Vector3::new(0.0, 0.0, 3.0),
            Matrix3::from_diagonal_element(300.0),
            Vector3::z(),
        ))
    }
}

fn start(device: impl HapticDevice + 'static) -> (HapticHandle, HapticPorts) {
    let chain = Chain::new(ChainConfig::default(), device.caps());
    // Ordinary priority: tests share the machine.
    let config = RealtimeConfig {
        real_time: false,
        ..RealtimeConfig::default()
    };
    spawn(Box::new(device), chain, config).unwrap()
}

/// Keeps the contact current until `is_enough`; returns the frames of the ring.
fn press_until(ports: &mut HapticPorts, mut is_enough: impl FnMut(&Frame) -> bool) -> Vec<Frame> {
    let mut frames = Vec::new();
    // Bound on the wait for the thread, far above the needs of any machine.
    for _ in 0..20_000 {
        ports.models.write(contact());
        while let Ok(frame) = ports.frames.pop() {
            frames.push(frame);
        }
        if is_enough(ports.newest.read()) {
            return frames;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    panic!("the thread never got there");
}

fn assert_no_step(written: &[Wrench]) {
    for pair in written.windows(2) {
        let step = (pair[1].force - pair[0].force).norm();
        assert!(step <= 0.6 + 1e-9, "a step of {step} N");
    }
}

#[test]
fn contact_is_rendered_and_stop_fades_it_before_closing() {
    let (device, diary) = Watched::new();
    let (handle, mut ports) = start(device);
    let frames = press_until(&mut ports, |f| f.wrench.force.z > 1.0);
    assert!(
        frames.windows(2).all(|w| w[0].time < w[1].time),
        "whole and in order"
    );
    let summary = handle.stop();
    assert!(summary.panicked.is_none());
    assert!(summary.stats.ticks > 0 && summary.stats.counters.ticks == summary.stats.ticks);
    assert!(!summary.trace.points().is_empty());
    let diary = diary.lock().unwrap();
    assert_no_step(&diary.written);
    assert_eq!(diary.written.last(), Some(&Wrench::ZERO));
    assert!(diary.closed && !diary.written_after_close);
}

#[test]
fn silent_device_gets_no_force_and_loop_continues() {
    let (mut device, diary) = Watched::new();
    device.fails_at = 600..700;
    let (handle, mut ports) = start(device);
    let mut ticks = 0;
    press_until(&mut ports, |_| {
        ticks = diary.lock().unwrap().written.len();
        ticks > 1000
    });
    let summary = handle.stop();
    assert_eq!(summary.stats.device.faults, 100);
    // One more tick passes while forces are enabled again.
    assert_eq!(summary.stats.counters.faulted, 101);
    let diary = diary.lock().unwrap();
    assert_no_step(&diary.written);
    assert!(
        diary.written[598].force.norm() > 0.5,
        "{:?}",
        diary.written[598]
    );
    assert_eq!(diary.written[698], Wrench::ZERO);
    assert!(diary.written[1000].force.norm() > 0.1, "force is back");
}

#[test]
fn driver_panic_ends_thread_and_closes_device() {
    let (mut device, diary) = Watched::new();
    device.panics_at = Some(50);
    let (handle, _ports) = start(device);
    while handle.is_running() {
        std::thread::sleep(Duration::from_millis(2));
    }
    let summary = handle.stop();
    assert!(summary.panicked.unwrap().contains("the driver's own bug"));
    assert!(diary.lock().unwrap().closed);
}

#[test]
fn lost_link_fades_force_and_restored_link_returns_it() {
    let (device, diary) = Watched::new();
    let (handle, mut ports) = start(device);
    press_until(&mut ports, |f| f.wrench.force.z > 1.0);
    handle.set_link_lost(true);
    press_until(&mut ports, |f| f.wrench == Wrench::ZERO);
    handle.set_link_lost(false);
    press_until(&mut ports, |f| f.wrench.force.z > 0.5);
    drop(handle);
    let diary = diary.lock().unwrap();
    assert_no_step(&diary.written);
    assert!(diary.closed, "dropping the handle is a stop");
}

#[test]
fn stalled_reader_loses_frames_only() {
    let (device, diary) = Watched::new();
    let (handle, ports) = start(device);
    while diary.lock().unwrap().written.len() < 400 {
        std::thread::sleep(Duration::from_millis(2));
    }
    let summary = handle.stop();
    assert_eq!(ports.frames.slots(), 256);
    assert_eq!(summary.stats.frames_dropped + 256, summary.stats.ticks);
}

#[test]
fn simulated_hand_starts_script_with_session() {
    use palpate_device::script::{Hand, Tool, Waypoint};
    let tool = Tool::probe(0.004);
    let waypoints = vec![
        Waypoint::new(0.0, Vector3::zeros()),
        Waypoint::new(0.1, Vector3::new(0.02, 0.0, 0.0)),
    ];
    let script = Script::new(tool, Hand::default(), waypoints, false).unwrap();
    let begin = ScriptStart::not_yet();
    let (handle, mut ports) = start(SimHand::new(script, begin.clone()));
    let mut seen = 0;
    while seen < 50 {
        let Ok(frame) = ports.frames.pop() else {
            std::thread::sleep(Duration::from_millis(2));
            continue;
        };
        seen += 1;
        assert_eq!(frame.sample.pose.position, Vector3::zeros());
    }
    begin.set(super::device_time(monotonic_now()));
    press_free_until(&mut ports, |f| f.sample.pose.position.x > 0.015);
    assert!(handle.stop().panicked.is_none());
}

fn press_free_until(ports: &mut HapticPorts, mut is_enough: impl FnMut(&Frame) -> bool) {
    while !is_enough(ports.newest.read()) {
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn device_with_own_clock_is_driven_alike() {
    for clock in [ClockOwner::DeviceCallback, ClockOwner::ReplyPerMessage] {
        let (mut device, _diary) = Watched::new();
        device.clock = clock;
        let (handle, mut ports) = start(device);
        press_free_until(&mut ports, |f| f.sample.time > DeviceTime::ZERO);
        assert!(handle.stop().panicked.is_none());
    }
}
