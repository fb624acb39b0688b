//! Tests of the gamepad on events, and behind a scripted port.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;

use super::{Axis, DeviceLost, Key, Pad, PadEvent, Port, Trigger, over, rate};
use crate::backend::steered::{Controls, Space, Steered};
use crate::{
    Buttons, DeviceFault, DeviceTime, Faults, HapticDevice, Pose, Rejection, Workspace, Wrench,
    Written, conformance,
};

fn after(events: &[PadEvent]) -> Controls {
    let mut pad = Pad::default();
    for event in events {
        pad.take(*event).unwrap();
    }
    pad.controls()
}

const AXES: [Axis; 6] = [
    Axis::LeftX,
    Axis::LeftY,
    Axis::RightX,
    Axis::RightY,
    Axis::CrossX,
    Axis::CrossY,
];

const KEYS: [Key; 12] = [
    Key::South,
    Key::East,
    Key::West,
    Key::North,
    Key::LeftShoulder,
    Key::RightShoulder,
    Key::Select,
    Key::Start,
    Key::CrossLeft,
    Key::CrossRight,
    Key::CrossUp,
    Key::CrossDown,
];

#[test]
fn sticks_push_right_away_and_up_and_turn_clockwise_to_the_right() {
    let one = |axis| after(&[PadEvent::Stick(axis, 1.0)]);
    assert_eq!(one(Axis::LeftX).push, Vector3::x());
    assert_eq!(one(Axis::LeftY).push, Vector3::y());
    assert_eq!(one(Axis::RightY).push, Vector3::z());
    assert_eq!(one(Axis::RightX).twist, -Vector3::z());
    // Seen from above, what points away goes to the right.
    let turn = UnitQuaternion::from_scaled_axis(one(Axis::RightX).twist * 0.1);
    assert!((turn * Vector3::y()).x > 0.0);
}

#[test]
fn the_cross_tilts_the_top_of_the_tool_in_its_direction() {
    let top = |key| {
        let twist = after(&[PadEvent::Key(key, true)]).twist;
        UnitQuaternion::from_scaled_axis(twist * 0.1) * Vector3::z()
    };
    assert!(top(Key::CrossRight).x > 0.05 && top(Key::CrossLeft).x < -0.05);
    assert!(top(Key::CrossUp).y > 0.05 && top(Key::CrossDown).y < -0.05);
    // A cross of two axes is one of four buttons.
    for (axis, key) in [
        (Axis::CrossX, Key::CrossRight),
        (Axis::CrossY, Key::CrossUp),
    ] {
        let buttons = after(&[PadEvent::Key(key, true)]).twist;
        assert_eq!(after(&[PadEvent::Stick(axis, 1.0)]).twist, buttons);
    }
}

#[test]
fn either_trigger_closes_the_gripper() {
    let squeeze = |l, r| {
        let events = [
            PadEvent::Trigger(Trigger::Left, l),
            PadEvent::Trigger(Trigger::Right, r),
        ];
        after(&events).gripper
    };
    assert_eq!(after(&[]).gripper, Some(1.0));
    assert_eq!(squeeze(0.0, 0.25), Some(0.75));
    assert_eq!(squeeze(1.0, 0.25), Some(0.0));
}

#[test]
fn shoulders_and_face_buttons_are_the_two_main_buttons() {
    for (keys, button) in [
        ([Key::South, Key::RightShoulder], Buttons::PRIMARY),
        ([Key::East, Key::LeftShoulder], Buttons::SECONDARY),
    ] {
        for key in keys {
            assert_eq!(after(&[PadEvent::Key(key, true)]).buttons, button);
        }
        // Releasing one of the two does not release the other.
        let three = [
            PadEvent::Key(keys[0], true),
            PadEvent::Key(keys[1], true),
            PadEvent::Key(keys[0], false),
        ];
        assert_eq!(after(&three).buttons, button);
    }
}

fn events() -> impl Strategy<Value = Vec<PadEvent>> {
    let place = prop_oneof![
        4 => -2.0..2.0f64,
        1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY]),
    ];
    let event = prop_oneof![
        (prop::sample::select(AXES.to_vec()), place.clone())
            .prop_map(|(axis, place)| PadEvent::Stick(axis, place)),
        place.prop_map(|place| PadEvent::Trigger(Trigger::Right, place)),
        (prop::sample::select(KEYS.to_vec()), any::<bool>())
            .prop_map(|(key, held)| PadEvent::Key(key, held)),
    ];
    prop::collection::vec(event, 0..60)
}

proptest! {
    #[test]
    fn no_event_leaves_the_range(events in events()) {
        let mut pad = Pad::default();
        for event in events {
            let _ = pad.take(event);
            let controls = pad.controls();
            prop_assert!(controls.push.iter().chain(&controls.twist).all(|c| c.abs() <= 1.0));
            prop_assert!((0.0..=1.0).contains(&controls.gripper.unwrap()));
        }
    }
}

/// Events one by one; after the last one nothing more, or the pad is switched off.
struct Script {
    events: VecDeque<PadEvent>,
    off: bool,
    done: Sender<()>,
    on: Receiver<Vec<PadEvent>>,
    shakes: Sender<f32>,
}

impl Port for Script {
    fn event(&mut self, patience: Duration) -> Result<Option<PadEvent>, DeviceLost> {
        let Some(event) = self.events.pop_front() else {
            let _ = self.done.send(());
            if self.off {
                return Err(DeviceLost);
            }
            let _ = self.on.recv_timeout(patience);
            return Ok(None);
        };
        Ok(Some(event))
    }

    fn reopen(&mut self) -> bool {
        let Ok(events) = self.on.try_recv() else {
            return false;
        };
        self.events = events.into();
        self.off = false;
        true
    }

    fn rumble(&mut self, strength: f32) {
        let _ = self.shakes.send(strength);
    }
}

struct Bench {
    device: Steered,
    done: Receiver<()>,
    on: Sender<Vec<PadEvent>>,
    shakes: Receiver<f32>,
}

fn pad(events: &[PadEvent], off: bool) -> Bench {
    let ((done, was_done), (on, ons), (shakes, shaken)) = (channel(), channel(), channel());
    let script = Script {
        events: events.iter().copied().collect(),
        off,
        done,
        on: ons,
        shakes,
    };
    let half = Vector3::repeat(0.1);
    let space = Space {
        workspace: Workspace {
            min: -half,
            max: half,
        },
        start: Pose::default(),
    };
    let device = over(script, "fake".to_owned(), rate(), &space).unwrap();
    was_done.recv().unwrap();
    Bench {
        device,
        done: was_done,
        on,
        shakes: shaken,
    }
}

fn at(ms: i64) -> DeviceTime {
    DeviceTime::from_micros(ms * 1000)
}

#[test]
fn it_passes_the_conformance_suite() {
    let mut bench = pad(
        &[
            PadEvent::Stick(Axis::LeftX, 1.0),
            PadEvent::Key(Key::South, true),
        ],
        false,
    );
    let mut ms = 0;
    let mut clock = || {
        ms += 1;
        at(ms)
    };
    let options = conformance::Options::default();
    let report = conformance::run(&mut bench.device, &mut clock, options);
    assert!(report.passed(), "{report}");
}

#[test]
fn a_held_stick_moves_the_tool_but_an_offset_rest_does_not() {
    let mut bench = pad(
        &[
            PadEvent::Stick(Axis::LeftY, 1.0),
            PadEvent::Stick(Axis::RightX, 0.1),
        ],
        false,
    );
    for ms in 0..1000 {
        bench.device.read(at(ms)).unwrap();
    }
    let sample = bench.device.read(at(1000)).unwrap();
    assert!(sample.velocity.y > 0.07);
    assert_eq!(sample.angular_velocity, Vector3::zeros());
}

#[test]
fn contact_rumbles_without_force() {
    let mut bench = pad(&[], false);
    let felt = Wrench::from_force(Vector3::new(5.0, 0.0, 0.0));
    for ms in 0..100 {
        bench.device.read(at(ms)).unwrap();
        let written = bench.device.write(at(ms), felt);
        assert_eq!(written, Written::Rejected(Rejection::NoMotors));
        bench.device.cue(at(ms), &felt);
    }
    assert_eq!(bench.shakes.recv().unwrap(), 1.0);
    assert_eq!(bench.device.rendered(), Wrench::ZERO);
    bench.device.close();
    assert_eq!(bench.shakes.try_iter().last(), Some(0.0));
}

#[test]
fn a_non_finite_position_is_a_fault_and_moves_nothing() {
    let mut bench = pad(&[PadEvent::Stick(Axis::LeftX, f64::NAN)], false);
    let sample = bench.device.read(at(0)).unwrap();
    assert!(sample.faults.contains(Faults::COMMUNICATION));
    assert_eq!(bench.device.read(at(1)).unwrap().pose, Pose::default());
}

#[test]
fn a_switched_off_pad_is_reported_and_returns_neutral() {
    let mut bench = pad(
        &[
            PadEvent::Stick(Axis::LeftX, 1.0),
            PadEvent::Key(Key::South, true),
        ],
        true,
    );
    while bench.device.read(at(0)).is_ok() {
        std::thread::yield_now();
    }
    assert_eq!(bench.device.read(at(1)), Err(DeviceFault::Unplugged));
    bench.on.send(Vec::new()).unwrap();
    bench.done.recv().unwrap();
    for ms in 2..100 {
        bench.device.read(at(ms)).unwrap();
    }
    let sample = bench.device.read(at(100)).unwrap();
    assert_eq!(
        (sample.velocity, sample.buttons),
        (Vector3::zeros(), Buttons::NONE)
    );
}
