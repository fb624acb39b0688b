//! Tests of the mouse on byte sequences, and behind a scripted port.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use nalgebra::Vector3;
use proptest::prelude::*;

use super::{BadReport, Cap, DeviceLost, MULTI_AXIS, Port, REPORT_BYTES_MAX, Report, known, over};
use crate::backend::steered::{Controls, RateControl, Space, Steered};
use crate::{Buttons, DeviceFault, DeviceTime, Faults, HapticDevice, Pose, Workspace, conformance};

/// The controls after these messages.
fn after(messages: &[&[u8]]) -> Controls {
    let mut cap = Cap::default();
    let mut controls = Controls::NEUTRAL;
    for message in messages {
        if let Some(report) = Report::parse(message).unwrap() {
            controls = cap.take(report);
        }
    }
    controls
}

/// 350, all the way, and −350.
const ALL: [u8; 2] = [0x5e, 0x01];
const BACK: [u8; 2] = [0xa2, 0xfe];

/// A message of three numbers, one of them `n`.
fn one(id: u8, axis: usize, n: [u8; 2]) -> [u8; 7] {
    let mut message = [0; 7];
    message[0] = id;
    message[1 + 2 * axis..3 + 2 * axis].copy_from_slice(&n);
    message
}

#[test]
fn a_push_goes_right_away_and_up_in_the_scene() {
    // Right, towards the user and down in the device's own axes.
    let push = |axis, n| after(&[&one(1, axis, n)]).push;
    assert_eq!(push(0, ALL), Vector3::new(1.0, 0.0, 0.0));
    assert_eq!(push(1, BACK), Vector3::new(0.0, 1.0, 0.0));
    assert_eq!(push(2, BACK), Vector3::new(0.0, 0.0, 1.0));
    assert_eq!(push(2, ALL), Vector3::new(0.0, 0.0, -1.0));
}

#[test]
fn a_twist_turns_as_the_hand_does() {
    let twist = |axis, n| after(&[&one(2, axis, n)]).twist;
    // Clockwise from above is a right-handed turn about down, and so a negative one about up.
    assert_eq!(twist(2, ALL), Vector3::new(0.0, 0.0, -1.0));
    assert_eq!(twist(0, ALL), Vector3::new(1.0, 0.0, 0.0));
    assert_eq!(twist(1, ALL), Vector3::new(0.0, -1.0, 0.0));
}

#[test]
fn the_captured_twist_of_a_space_navigator_is_read() {
    // Captured message: 0xffe2 is -30 about the second axis.
    let twist = after(&[&[2, 0, 0, 0xe2, 0xff, 0, 0]]).twist;
    assert!((twist - Vector3::new(0.0, 30.0 / 350.0, 0.0)).norm() < 1e-15);
}

#[test]
fn two_messages_of_old_devices_equal_one_of_new_devices() {
    let (push, twist) = (one(1, 0, ALL), one(2, 2, BACK));
    let mut both = [0; 13];
    both[..7].copy_from_slice(&push);
    both[7..].copy_from_slice(&twist[1..]);
    assert_eq!(after(&[&push, &twist]), after(&[&both]));
}

#[test]
fn a_message_keeps_the_state_it_does_not_contain() {
    let controls = after(&[
        &one(1, 0, ALL),
        &[3, 0x03, 0x00],
        &[0x17, 100, 1],
        &one(2, 0, ALL),
    ]);
    assert_eq!(controls.push.x, 1.0);
    assert_eq!(controls.twist.x, 1.0);
    let both = Buttons::PRIMARY.with(Buttons::SECONDARY);
    assert_eq!(controls.buttons, both);
    assert_eq!(after(&[&[3, 3, 0], &[3, 0, 0]]).buttons, Buttons::NONE);
    // Button 27 of a SpaceMouse Pro is bit 26.
    assert_eq!(
        after(&[&[3, 0, 0, 0, 4]]).buttons,
        Buttons::from_bits(1 << 26)
    );
}

#[test]
fn a_push_beyond_the_range_is_clamped() {
    assert_eq!(after(&[&one(1, 0, [0xff, 0x7f])]).push.x, 1.0);
    assert_eq!(after(&[&one(1, 0, [0x00, 0x80])]).push.x, -1.0);
}

proptest! {
    #[test]
    fn any_bytes_are_a_message_within_range_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
        let mut cap = Cap::default();
        if let Ok(Some(report)) = Report::parse(&bytes) {
            let controls = cap.take(report);
            prop_assert!(controls.push.iter().chain(&controls.twist).all(|c| c.abs() <= 1.0));
        }
    }

    #[test]
    fn a_truncated_message_is_shorter_or_rejected(
        numbers in prop::array::uniform12(any::<u8>()), id in 1..=2u8, cut in 0..13usize,
    ) {
        let whole: Vec<u8> = [id].into_iter().chain(numbers).collect();
        let short = Report::parse(&whole[..cut]);
        match Report::parse(&whole).unwrap().unwrap() {
            Report::Both { push, .. } if cut >= 7 => prop_assert_eq!(short, Ok(Some(Report::Push(push)))),
            said @ Report::Twist(_) if cut >= 7 => prop_assert_eq!(short, Ok(Some(said))),
            _ => prop_assert_eq!(short, Err(BadReport)),
        }
    }
}

#[test]
fn ordinary_mice_are_not_6_dof_mice() {
    assert_eq!(known(0x046d, 0xc626, None), Some("SpaceNavigator"));
    assert_eq!(
        known(0x256f, 0xc635, Some(MULTI_AXIS)),
        Some("SpaceMouse Compact")
    );
    // A mouse of Logitech, the mouse interface of a receiver, and a device that came after this was written.
    assert_eq!(known(0x046d, 0xc077, Some((1, 2))), None);
    assert_eq!(known(0x046d, 0xc077, Some(MULTI_AXIS)), None);
    assert_eq!(known(0x256f, 0xc652, Some((1, 2))), None);
    assert_eq!(known(0x256f, 0xcfff, Some(MULTI_AXIS)), Some("6-DOF mouse"));
    assert_eq!(known(0x256f, 0xcfff, None), None);
    assert_eq!(known(0x1234, 0xc626, None), None);
}

/// Messages one by one; after the last one nothing more, or the plug is pulled.
struct Wire {
    messages: VecDeque<Vec<u8>>,
    pulled: bool,
    read: Sender<()>,
    plug: Receiver<Vec<Vec<u8>>>,
}

impl Port for Wire {
    fn report(
        &mut self,
        into: &mut [u8; REPORT_BYTES_MAX],
        patience: Duration,
    ) -> Result<usize, DeviceLost> {
        let Some(message) = self.messages.pop_front() else {
            let _ = self.read.send(());
            if self.pulled {
                return Err(DeviceLost);
            }
            // No message arrives; the wait takes the time.
            let _ = self.plug.recv_timeout(patience);
            return Ok(0);
        };
        into[..message.len()].copy_from_slice(&message);
        Ok(message.len())
    }

    fn reopen(&mut self) -> bool {
        let Ok(messages) = self.plug.try_recv() else {
            return false;
        };
        self.messages = messages.into();
        self.pulled = false;
        true
    }
}

/// A mouse that has sent all messages, a signal for that, and its plug.
fn mouse(messages: &[&[u8]], pulled: bool) -> (Steered, Receiver<()>, Sender<Vec<Vec<u8>>>) {
    let ((read, was_read), (plug, plugged)) = (channel(), channel());
    let wire = Wire {
        messages: messages.iter().map(|m| m.to_vec()).collect(),
        pulled,
        read,
        plug: plugged,
    };
    let half = Vector3::repeat(0.1);
    let space = Space {
        workspace: Workspace {
            min: -half,
            max: half,
        },
        start: Pose::default(),
    };
    let device = over(wire, "fake".to_owned(), RateControl::default(), &space).unwrap();
    was_read.recv().unwrap();
    (device, was_read, plug)
}

fn at(ms: i64) -> DeviceTime {
    DeviceTime::from_micros(ms * 1000)
}

#[test]
fn it_passes_the_conformance_suite() {
    let (mut device, _read, _plug) = mouse(&[&one(1, 0, ALL), &one(2, 1, ALL), &[3, 1, 0]], false);
    let mut ms = 0;
    let mut clock = || {
        ms += 1;
        at(ms)
    };
    let report = conformance::run(&mut device, &mut clock, conformance::Options::default());
    assert!(report.passed(), "{report}");
}

#[test]
fn a_held_cap_moves_the_tool_but_a_silent_one_does_not() {
    let (mut device, _read, _plug) = mouse(&[&one(1, 2, BACK), &[3, 1, 0]], false);
    for ms in 0..200 {
        device.read(at(ms)).unwrap();
    }
    let moving = device.read(at(200)).unwrap();
    assert!(moving.velocity.z > 0.07 && moving.pose.position.z > 0.01);
    assert_eq!(moving.buttons, Buttons::PRIMARY);
    for ms in 201..1000 {
        device.read(at(ms)).unwrap();
    }
    assert!(device.read(at(1000)).unwrap().velocity.norm() < 1e-5);
}

#[test]
fn garbage_on_the_wire_is_a_fault_and_moves_nothing() {
    let (mut device, _read, _plug) = mouse(&[&[1, 0xff], &[2], &[3], &[0xee; 64]], false);
    let sample = device.read(at(0)).unwrap();
    assert!(sample.faults.contains(Faults::COMMUNICATION));
    assert_eq!(device.garbled(), 3);
    assert_eq!(device.read(at(1)).unwrap().pose, Pose::default());
}

#[test]
fn a_pulled_plug_is_reported_and_the_mouse_reconnects() {
    let (mut device, read, plug) = mouse(&[&one(1, 0, ALL)], true);
    while device.read(at(0)).is_ok() {
        std::thread::yield_now();
    }
    assert_eq!(device.read(at(1)), Err(DeviceFault::Unplugged));
    plug.send(vec![one(1, 1, BACK).to_vec()]).unwrap();
    read.recv().unwrap();
    for ms in 2..300 {
        device.read(at(ms)).unwrap();
    }
    // The push from before is cleared.
    let sample = device.read(at(300)).unwrap();
    assert!(sample.velocity.y > 0.0 && sample.velocity.x == 0.0);
}
