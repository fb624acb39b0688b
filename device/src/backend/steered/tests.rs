//! Laws of steering, and tests of a device with a scripted source.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;

use super::{
    Controls, DeviceLost, Kind, PAUSE_MAX_US, RateControl, Rumble, Source, SourceEvent, Space,
    Steered, Steering,
};
use crate::{
    Buttons, DeviceFault, DeviceTime, Faults, HapticDevice, Pose, Workspace, Wrench, conformance,
};

fn at(us: i64) -> DeviceTime {
    DeviceTime::from_micros(us)
}

fn room() -> Workspace {
    Workspace {
        min: Vector3::repeat(-0.1),
        max: Vector3::repeat(0.1),
    }
}

fn steering() -> Steering {
    Steering::new(RateControl::default(), room(), Pose::default()).unwrap()
}

#[test]
fn full_deflection_reaches_its_speed_along_its_own_axis() {
    for axis in 0..3 {
        let mut tool = steering();
        let mut push = Vector3::zeros();
        push[axis] = 1.0;
        for ms in 0..500 {
            tool.advance(at(ms * 1000), &push, &push);
        }
        let rate = RateControl::default();
        assert!((tool.velocity() - push * rate.speed_m_per_s).norm() < 1e-4);
        assert!((tool.angular_velocity() - push * rate.turn_rad_per_s).norm() < 1e-3);
        // A ramp is followed one time constant behind.
        let way = rate.speed_m_per_s * (0.499 - rate.follow_s);
        assert!((tool.pose().position - push * way).norm() < 1e-4);
        let turn = rate.turn_rad_per_s * (0.499 - rate.follow_s);
        let turned = UnitQuaternion::from_scaled_axis(push * turn);
        assert!(tool.pose().orientation.angle_to(&turned) < 1e-3);
    }
}

#[test]
fn speed_is_zero_in_the_dead_zone_and_continuous_beyond() {
    let rate = RateControl::default();
    let d = Vector3::new(0.6, -0.8, 0.0);
    assert_eq!(rate.shape(&(d * 0.08)), Vector3::zeros());
    assert!(rate.shape(&(d * 0.080_001)).norm() < 1e-6);
    assert!((rate.shape(&(d * 0.5)).normalize() - d).norm() < 1e-12);
    // Corners of a square stick are no faster than its sides.
    assert!((rate.shape(&Vector3::repeat(1.0)).norm() - 1.0).abs() < 1e-12);
    assert_eq!(
        rate.shape(&Vector3::new(f64::NAN, 0.0, 0.0)),
        Vector3::zeros()
    );
}

#[test]
fn the_times_of_reading_hardly_matter() {
    let push = Vector3::new(0.4, 0.0, -0.7);
    let (mut often, mut rarely) = (steering(), steering());
    for us in (0..=300_000).step_by(500) {
        often.advance(at(us), &push, &push);
    }
    for us in (0..=300_000).step_by(50_000) {
        rarely.advance(at(us), &push, &push);
    }
    assert!((often.pose().position - rarely.pose().position).norm() < 1e-9);
    assert!(
        often
            .pose()
            .orientation
            .angle_to(&rarely.pose().orientation)
            < 1e-6
    );
}

#[test]
fn a_pause_moves_nothing_and_is_reported() {
    let push = Vector3::new(1.0, 0.0, 0.0);
    let mut tool = steering();
    for ms in 0..200 {
        assert_eq!(tool.advance(at(ms * 1000), &push, &push), Faults::NONE);
    }
    let before = *tool.pose();
    let faults = tool.advance(at(200_000 + PAUSE_MAX_US), &push, &push);
    assert!(faults.contains(Faults::TIME_JUMP));
    assert_eq!((*tool.pose(), tool.velocity()), (before, Vector3::zeros()));
}

#[test]
fn an_invalid_rate_is_rejected_by_name() {
    let rate = RateControl {
        follow_s: f64::NAN,
        ..RateControl::default()
    };
    let why = Steering::new(rate, room(), Pose::default()).unwrap_err();
    assert!(why.to_string().contains("follow_s"), "{why}");
}

/// A deflection and for how long, ms.
fn deflections() -> impl Strategy<Value = Vec<(Vector3<f64>, i64)>> {
    let number = prop_oneof![
        10 => -1.5..1.5f64,
        1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, 1.0, -1.0]),
    ];
    let push = prop::array::uniform3(number).prop_map(Vector3::from);
    prop::collection::vec((push, 1..400i64), 1..30)
}

proptest! {
    #[test]
    fn no_input_leaves_the_workspace_or_makes_the_velocity_jump(run in deflections(), follow_s in 0.02..0.2f64) {
        let rate = RateControl { follow_s, speed_m_per_s: 0.5, ..RateControl::default() };
        let mut tool = Steering::new(rate, room(), Pose::default()).unwrap();
        let mut now = 0;
        let most = |speed: f64| 2.0 * 3f64.sqrt() * speed * (1.0 - (-1e-3 / follow_s).exp()) + 1e-12;
        for (push, ms) in run {
            for _ in 0..ms {
                now += 1000;
                let (x, v, w) = (tool.pose().position, tool.velocity(), tool.angular_velocity());
                tool.advance(at(now), &push, &push);
                prop_assert!(room().contains(&tool.pose().position));
                prop_assert!(tool.pose().is_finite());
                // Not at the walls either.
                prop_assert!((tool.velocity() - v).norm() <= most(rate.speed_m_per_s));
                prop_assert!((tool.angular_velocity() - w).norm() <= most(rate.turn_rad_per_s));
                // The reported velocity is the derivative of the position.
                let moved = (tool.pose().position - x) * 1e3;
                prop_assert!((moved - v).norm() <= most(rate.speed_m_per_s));
            }
        }
    }
}

/// Request of the script to the driver's thread.
enum Order {
    Say(SourceEvent),
    Vanish,
    Panic,
}

/// A source that follows requests and signals each wait for the next one: earlier messages have arrived by then.
struct Scripted {
    orders: Receiver<Order>,
    waits: Sender<()>,
    back: Receiver<()>,
    hints: Sender<f32>,
}

impl Source for Scripted {
    fn listen(&mut self, _patience: Duration) -> Result<SourceEvent, DeviceLost> {
        let _ = self.waits.send(());
        match self.orders.recv() {
            Ok(Order::Say(news)) => Ok(news),
            Ok(Order::Panic) => panic!("the driver's own bug"),
            Ok(Order::Vanish) => Err(DeviceLost),
            Err(_) => Ok(SourceEvent::Quiet),
        }
    }

    fn reopen(&mut self) -> bool {
        self.back.try_recv().is_ok()
    }

    fn hint(&mut self, strength: f32) {
        let _ = self.hints.send(strength);
    }
}

/// A steered device and the ends of its script.
struct Bench {
    device: Steered,
    orders: Sender<Order>,
    waits: Receiver<()>,
    back: Sender<()>,
    hints: Receiver<f32>,
}

impl Bench {
    fn new(silence_max_us: Option<i64>) -> Self {
        let (orders, orders_out) = channel();
        let (waits_in, waits) = channel();
        let (back, back_out) = channel();
        let (hints_in, hints) = channel();
        let source = Scripted {
            orders: orders_out,
            waits: waits_in,
            back: back_out,
            hints: hints_in,
        };
        let kind = Kind {
            name: "script".to_owned(),
            dof_in: 6,
            silence_max_us,
            rate: RateControl::default(),
            rumble: Some(Rumble::default()),
        };
        let space = Space {
            workspace: room(),
            start: Pose::default(),
        };
        let device = Steered::open(Box::new(source), kind, &space).unwrap();
        waits.recv().unwrap();
        Self {
            device,
            orders,
            waits,
            back,
            hints,
        }
    }

    /// Sends a request and waits until it is done.
    fn order(&self, order: Order) {
        self.orders.send(order).unwrap();
        self.waits.recv().unwrap();
    }

    fn push(&self, x: f64) {
        let push = Vector3::new(x, 0.0, 0.0);
        self.order(Order::Say(SourceEvent::Controls(Controls {
            push,
            buttons: Buttons::PRIMARY,
            gripper: Some(0.5),
            ..Controls::NEUTRAL
        })));
    }
}

#[test]
fn it_passes_the_conformance_suite() {
    let Bench {
        mut device, orders, ..
    } = Bench::new(None);
    // A thread that waits for a request can not be closed.
    drop(orders);
    let mut us = 0;
    let mut clock = || {
        us += 1000;
        at(us)
    };
    let report = conformance::run(&mut device, &mut clock, conformance::Options::default());
    assert!(report.passed(), "{report}");
}

#[test]
fn controls_of_the_hand_reach_the_sample() {
    let mut bench = Bench::new(None);
    bench.push(1.0);
    for ms in 0..300 {
        bench.device.read(at(ms * 1000)).unwrap();
    }
    let sample = bench.device.read(at(300_000)).unwrap();
    assert!(sample.velocity.x > 0.07 && sample.pose.position.x > 0.015);
    assert_eq!(
        (sample.buttons, sample.gripper),
        (Buttons::PRIMARY, Some(0.5))
    );
    drop(bench.orders);
}

#[test]
fn a_silent_device_stops_the_tool_and_keeps_its_buttons() {
    let mut bench = Bench::new(Some(250_000));
    bench.push(1.0);
    let speed = |device: &mut Steered, from: i64, to: i64| {
        let samples = (from..to).map(|ms| device.read(at(ms * 1000)).unwrap());
        samples.last().unwrap()
    };
    assert!(speed(&mut bench.device, 0, 250).velocity.x > 0.07);
    let later = speed(&mut bench.device, 250, 1000);
    assert!(later.velocity.norm() < 1e-6);
    assert_eq!(later.buttons, Buttons::PRIMARY);
    drop(bench.orders);
}

#[test]
fn garbage_is_a_fault_once_and_moves_nothing() {
    let mut bench = Bench::new(None);
    let nan = Controls {
        push: Vector3::repeat(f64::NAN),
        ..Controls::NEUTRAL
    };
    for garbage in [SourceEvent::Garbled, SourceEvent::Controls(nan)] {
        bench.order(Order::Say(garbage));
        let sample = bench.device.read(at(0)).unwrap();
        assert!(sample.faults.contains(Faults::COMMUNICATION));
        assert_eq!(sample.pose, Pose::default());
        assert_eq!(bench.device.read(at(0)).unwrap().faults, Faults::NONE);
    }
    assert_eq!(bench.device.garbled(), 2);
    drop(bench.orders);
}

#[test]
fn an_unplugged_device_is_reported_and_resumes_from_rest() {
    let mut bench = Bench::new(None);
    bench.push(1.0);
    for ms in 0..100 {
        bench.device.read(at(ms * 1000)).unwrap();
    }
    let before = bench.device.read(at(100_000)).unwrap();
    bench.orders.send(Order::Vanish).unwrap();
    // The thread runs asynchronously.
    while bench.device.read(at(100_000)).is_ok() {
        std::thread::yield_now();
    }
    assert_eq!(bench.device.read(at(101_000)), Err(DeviceFault::Unplugged));
    bench.back.send(()).unwrap();
    bench.waits.recv().unwrap();
    let after = bench.device.read(at(9_000_000)).unwrap();
    assert_eq!(after.velocity, Vector3::zeros());
    assert_eq!(after.buttons, Buttons::NONE);
    assert!((after.pose.position - before.pose.position).norm() < 1e-12);
    bench.push(-1.0);
    assert!(bench.device.read(at(9_001_000)).unwrap().velocity.x < 0.0);
    drop(bench.orders);
}

#[test]
fn a_driver_that_panics_is_an_unplugged_device() {
    let mut bench = Bench::new(None);
    bench.orders.send(Order::Panic).unwrap();
    while bench.device.read(at(0)).is_ok() {
        std::thread::yield_now();
    }
    assert_eq!(bench.device.read(at(0)), Err(DeviceFault::Unplugged));
    bench.device.close();
}

#[test]
fn a_force_becomes_a_cue_that_ends_with_the_device() {
    let mut bench = Bench::new(None);
    let felt = Wrench::from_force(Vector3::new(0.0, 3.0, 4.0));
    bench.device.cue(at(0), &felt);
    bench.order(Order::Say(SourceEvent::Quiet));
    assert_eq!(bench.hints.recv().unwrap(), 1.0);
    drop(bench.orders);
    bench.device.close();
    assert_eq!(bench.hints.try_iter().last(), Some(0.0));
    bench.device.cue(at(1_000_000), &felt);
    assert_eq!(bench.hints.try_iter().count(), 0);
}
