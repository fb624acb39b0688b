//! The laws of the pointer.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use proptest::prelude::*;

use super::{EVENTS_MAX, Pointer, PointerConfig, PointerEvent, PointerHandle, RATE_PER_S};
use crate::{
    Buttons, DeviceFault, DeviceTime, Faults, HapticDevice, Pose, Sample, Workspace, conformance,
};

fn room() -> Workspace {
    Workspace {
        min: Vector3::repeat(-0.1),
        max: Vector3::repeat(0.1),
    }
}

fn pointer() -> (Pointer, PointerHandle) {
    Pointer::new(&PointerConfig::new(room(), Pose::default())).unwrap()
}

fn at(us: i64) -> DeviceTime {
    DeviceTime::from_micros(us)
}

fn event(us: i64, x: f64, z: f64) -> PointerEvent {
    PointerEvent {
        time: at(us),
        goal: Some(Pose::at(Vector3::new(x, 0.0, z))),
        buttons: Buttons::NONE,
    }
}

/// Reads every millisecond from `from` to before `to` ms; the last sample.
fn run(device: &mut Pointer, from: i64, to: i64) -> Sample {
    let samples = (from..to).map(|ms| device.read(at(ms * 1000)).unwrap());
    samples.last().unwrap()
}

#[test]
fn it_passes_the_conformance_suite() {
    let (mut device, mut handle) = pointer();
    handle.send(event(0, 0.05, 0.02)).unwrap();
    let mut us = 0;
    let mut clock = || {
        us += 1000;
        at(us)
    };
    let report = conformance::run(&mut device, &mut clock, conformance::Options::default());
    assert!(report.passed(), "{report}");
}

#[test]
fn the_tool_comes_to_rest_at_the_goal() {
    let (mut device, mut handle) = pointer();
    handle.send(event(0, 0.05, -0.02)).unwrap();
    let sample = run(&mut device, 0, 600);
    assert!((sample.pose.position - Vector3::new(0.05, 0.0, -0.02)).norm() < 1e-6);
    assert!(sample.velocity.norm() < 1e-5);
}

#[test]
fn a_pointer_of_60_hz_gives_a_steady_velocity() {
    let (mut device, mut handle) = pointer();
    let (v, mut next) = (0.05, 0);
    let mut speeds = Vec::new();
    let mut before = Sample::resting(at(0), Pose::default());
    for ms in 0..1500 {
        if ms * 60 >= next * 1000 {
            next += 1;
            let x = v * ms as f64 * 1e-3 - 0.03;
            handle.send(event(ms * 1000, x, 0.0)).unwrap();
        }
        let sample = device.read(at(ms * 1000)).unwrap();
        let jump = (sample.velocity - before.velocity).norm();
        assert!(
            jump < 1e-3 * RATE_PER_S * 0.4 * 2.0,
            "{jump} m/s at {ms} ms"
        );
        let moved = (sample.pose.position - before.pose.position) * 1e3;
        assert!((moved - (sample.velocity + before.velocity) / 2.0).norm() < 1e-3);
        if ms > 500 {
            speeds.push(sample.velocity.x);
        }
        before = sample;
    }
    let ripple = speeds.iter().map(|s| (s / v - 1.0).abs());
    let most = ripple.fold(0.0, f64::max);
    // The first harmonic's 2 w²/(w² + W²), plus the other harmonics.
    assert!((0.04..0.08).contains(&most), "{most}");
}

#[test]
fn the_tool_lags_a_steady_pointer_by_two_time_constants() {
    let (mut device, mut handle) = pointer();
    let v = 0.1;
    let mut sample = Sample::resting(at(0), Pose::default());
    for ms in 0..800 {
        let x = v * ms as f64 * 1e-3;
        handle.send(event(ms * 1000, x, 0.0)).unwrap();
        sample = device.read(at(ms * 1000)).unwrap();
    }
    let late_s = (v * 0.799 - sample.pose.position.x) / v;
    // The step that receives an event also moves the lead.
    assert!((late_s - 2.0 / RATE_PER_S).abs() < 1e-3, "{late_s} s");
}

#[test]
fn without_events_or_pointer_the_tool_stays_in_place() {
    let (mut device, mut handle) = pointer();
    let pressed = PointerEvent {
        buttons: Buttons::PRIMARY,
        ..event(0, 0.09, 0.0)
    };
    handle.send(pressed).unwrap();
    assert_eq!(run(&mut device, 0, 100).buttons, Buttons::PRIMARY);
    let left = PointerEvent {
        goal: None,
        time: at(100_000),
        ..pressed
    };
    let from = device.read(at(100_000)).unwrap();
    handle.send(left).unwrap();
    let stopped = run(&mut device, 101, 500);
    assert_eq!(stopped.buttons, Buttons::NONE);
    assert!(stopped.velocity.norm() < 1e-6);
    // At most the distance of the lag.
    let on = stopped.pose.position.x - from.pose.position.x;
    assert!(
        (0.0..=0.4 * 2.0 / RATE_PER_S + 1e-3).contains(&on),
        "{on} m"
    );
    let later = run(&mut device, 500, 3000);
    assert!((later.pose.position - stopped.pose.position).norm() < 1e-9);
}

#[test]
fn a_click_between_two_readings_appears_in_one() {
    let (mut device, mut handle) = pointer();
    let down = PointerEvent {
        buttons: Buttons::PRIMARY,
        ..event(100, 0.0, 0.0)
    };
    handle.send(down).unwrap();
    handle.send(event(200, 0.0, 0.0)).unwrap();
    assert_eq!(device.read(at(1000)).unwrap().buttons, Buttons::PRIMARY);
    assert_eq!(device.read(at(2000)).unwrap().buttons, Buttons::NONE);
}

#[test]
fn invalid_events_are_rejected_and_reported_once() {
    let (mut device, mut handle) = pointer();
    let turned = |coords: [f64; 4]| {
        let orientation = UnitQuaternion::new_unchecked(Quaternion::from(coords));
        PointerEvent {
            goal: Some(Pose {
                orientation,
                ..Pose::default()
            }),
            ..event(0, 0.0, 0.0)
        }
    };
    let bad = [
        event(0, f64::NAN, 0.0),
        event(0, 0.0, f64::NEG_INFINITY),
        event(0, 2e3, 0.0),
        turned([0.0; 4]),
        turned([0.0, f64::NAN, 0.0, 1.0]),
        turned([1.0, 0.0, 0.0, 1.0]),
    ];
    for event in bad {
        handle.send(event).unwrap();
        let sample = device.read(at(0)).unwrap();
        assert!(sample.faults.contains(Faults::COMMUNICATION));
        assert_eq!(sample.pose, Pose::default());
    }
    assert_eq!(device.read(at(0)).unwrap().faults, Faults::NONE);
    handle.send(event(5000, 0.0, 0.0)).unwrap();
    handle.send(event(4000, 0.05, 0.0)).unwrap();
    // The later event came first, so the earlier one moves nothing.
    let sample = run(&mut device, 6, 300);
    assert_eq!(sample.pose.position, Vector3::zeros());
}

#[test]
fn an_old_event_releases_but_presses_no_button() {
    let (mut device, mut handle) = pointer();
    let with = |us, bits| PointerEvent {
        buttons: Buttons::from_bits(bits),
        ..event(us, 0.0, 0.0)
    };
    handle.send(with(0, 0b01)).unwrap();
    assert_eq!(device.read(at(0)).unwrap().buttons.bits(), 0b01);
    handle.send(with(1000, 0b11)).unwrap();
    assert_eq!(device.read(at(900_000)).unwrap().buttons.bits(), 0b01);
    handle.send(with(2000, 0b10)).unwrap();
    assert_eq!(device.read(at(901_000)).unwrap().buttons.bits(), 0b00);
}

#[test]
fn an_unread_queue_reports_that_it_is_full() {
    let (_device, mut handle) = pointer();
    for i in 0..EVENTS_MAX {
        handle.send(event(i as i64, 0.0, 0.0)).unwrap();
    }
    assert!(handle.send(event(9999, 0.0, 0.0)).is_err());
}

#[test]
fn without_a_view_the_device_is_unplugged_and_at_rest() {
    let (mut device, mut handle) = pointer();
    handle.send(event(0, 0.09, 0.0)).unwrap();
    run(&mut device, 0, 100);
    drop(handle);
    assert_eq!(device.read(at(100_000)), Err(DeviceFault::Unplugged));
    assert_eq!(device.read(at(101_000)), Err(DeviceFault::Unplugged));
}

#[test]
fn the_tool_turns_to_the_goal_in_place() {
    let (mut device, mut handle) = pointer();
    let turned = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.5, 0.4));
    let goal = Pose {
        orientation: turned,
        ..Pose::default()
    };
    let turn = PointerEvent {
        goal: Some(goal),
        ..event(0, 0.0, 0.0)
    };
    handle.send(turn).unwrap();
    let sample = run(&mut device, 0, 800);
    assert!(sample.pose.orientation.angle_to(&turned) < 1e-6);
    assert_eq!(sample.pose.position, Vector3::zeros());
}

#[test]
fn a_goal_beyond_the_wall_leaves_the_tool_at_the_wall() {
    let (mut device, mut handle) = pointer();
    handle.send(event(0, 0.3, 0.05)).unwrap();
    let at_wall = run(&mut device, 0, 900);
    assert!((at_wall.pose.position - Vector3::new(0.1, 0.0, 0.05)).norm() < 1e-6);
    // A goal that returns moves the tool at once.
    handle.send(event(900_000, 0.05, 0.05)).unwrap();
    let back = run(&mut device, 900, 950);
    assert!(back.pose.position.x < 0.095, "{back:?}");
}

#[test]
fn a_view_that_is_gone_releases_every_button_whatever_its_time() {
    let (mut device, mut handle) = pointer();
    let pressed = PointerEvent {
        buttons: Buttons::PRIMARY,
        ..event(5000, 0.0, 0.0)
    };
    handle.send(pressed).unwrap();
    assert_eq!(device.read(at(6000)).unwrap().buttons, Buttons::PRIMARY);
    let gone = PointerEvent {
        time: at(4000),
        goal: None,
        ..pressed
    };
    handle.send(gone).unwrap();
    assert_eq!(device.read(at(7000)).unwrap().buttons, Buttons::NONE);
}

#[test]
fn an_event_from_the_future_blocks_no_later_event() {
    let (mut device, mut handle) = pointer();
    let press = |us| PointerEvent {
        buttons: Buttons::PRIMARY,
        ..event(us, 0.0, 0.0)
    };
    // An hour ahead it presses nothing; a little ahead it does.
    handle.send(press(3_600_000_000)).unwrap();
    assert_eq!(device.read(at(1000)).unwrap().buttons, Buttons::NONE);
    handle.send(press(100_000)).unwrap();
    assert_eq!(device.read(at(2000)).unwrap().buttons, Buttons::PRIMARY);
    handle.send(event(2500, 0.0, 0.0)).unwrap();
    assert_eq!(device.read(at(3000)).unwrap().buttons, Buttons::NONE);
}

fn events() -> impl Strategy<Value = Vec<(PointerEvent, i64)>> {
    let number = || {
        prop_oneof![
            10 => -0.3..0.3f64,
            1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, -1e9, 999.0]),
        ]
    };
    let goal = (
        [number(), number(), number()],
        [number(), number(), number()],
    );
    let goal = goal.prop_map(|(at, turn)| Pose {
        position: Vector3::from(at),
        orientation: UnitQuaternion::from_scaled_axis(Vector3::from(turn) * 10.0),
    });
    let event = (prop::option::weighted(0.9, goal), 0..4u32, -2000..9000i64);
    let event = event.prop_map(|(goal, buttons, us)| PointerEvent {
        time: DeviceTime::from_micros(us),
        goal,
        buttons: Buttons::from_bits(buttons),
    });
    prop::collection::vec((event, 0..60i64), 1..40)
}

proptest! {
    #[test]
    fn no_pointer_moves_the_tool_out_of_its_box_or_above_its_speed(run in events()) {
        let config = PointerConfig::new(room(), Pose::default());
        let (mut device, mut handle) = Pointer::new(&config).unwrap();
        let mut now = 0;
        let mut before = Sample::resting(at(0), Pose::default());
        for (mut event, ms) in run {
            event.time = event.time.plus_micros(now);
            handle.send(event).unwrap();
            for _ in 0..ms {
                now += 1000;
                let sample = device.read(at(now)).unwrap();
                prop_assert!(sample.is_finite());
                prop_assert!(room().contains(&sample.pose.position));
                prop_assert!(sample.velocity.norm() <= config.speed_m_per_s * (1.0 + 1e-9));
                // |x''| = w² |r - x - 2 x'/w|, and both are at most 2 V/w.
                let jump = (sample.velocity - before.velocity).norm();
                prop_assert!(jump <= 4.0 * RATE_PER_S * config.speed_m_per_s * 1e-3);
                let moved = (sample.pose.position - before.pose.position) * 1e3;
                prop_assert!(moved.norm() <= config.speed_m_per_s * (1.0 + 1e-6));
                let turned = sample.pose.orientation.angle_to(&before.pose.orientation) * 1e3;
                prop_assert!(turned <= 1.2 * config.turn_rad_per_s);
                before = sample;
            }
        }
    }
}
