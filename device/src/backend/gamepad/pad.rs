//! What the hand does to a gamepad, put together from events.

use nalgebra::Vector3;

use crate::Buttons;
use crate::backend::steered::Controls;

/// An axis of a stick, or of a cross that says where it is pressed as a stick does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// The left stick, to the right.
    LeftX,
    /// The left stick, up.
    LeftY,
    /// The right stick, to the right.
    RightX,
    /// The right stick, up.
    RightY,
    /// The cross, to the right.
    CrossX,
    /// The cross, up.
    CrossY,
}

/// The number of [`Axis`]es.
const AXES: usize = 6;

/// A trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trigger {
    /// Under the left hand.
    Left,
    /// Under the right hand.
    Right,
}

/// A button, named by its place, because what is printed on it differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// The lower one of the four.
    South,
    /// The right one of the four.
    East,
    /// The left one of the four.
    West,
    /// The upper one of the four.
    North,
    /// The left shoulder.
    LeftShoulder,
    /// The right shoulder.
    RightShoulder,
    /// The small one on the left of the middle.
    Select,
    /// The small one on the right of the middle.
    Start,
    /// The cross, left.
    CrossLeft,
    /// The cross, right.
    CrossRight,
    /// The cross, up.
    CrossUp,
    /// The cross, down.
    CrossDown,
}

/// The number of [`Key`]s.
const KEYS: usize = 12;

/// Something happens on a gamepad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PadEvent {
    /// A stick is at this place along one axis, −1 to 1.
    Stick(Axis, f64),
    /// A trigger is pressed so far, 0 to 1.
    Trigger(Trigger, f64),
    /// A button is held, or no longer.
    Key(Key, bool),
}

/// A gamepad as it is held.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pad {
    sticks: [f64; AXES],
    triggers: [f64; 2],
    keys: [bool; KEYS],
}

/// A place that is no number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the gamepad gave a place that is no number")]
pub struct NoNumber;

impl Pad {
    /// Takes an event in. A number out of range counts as the end of the range.
    pub fn take(&mut self, event: PadEvent) -> Result<(), NoNumber> {
        match event {
            PadEvent::Stick(_, place) | PadEvent::Trigger(_, place) if place.is_nan() => {
                return Err(NoNumber);
            }
            PadEvent::Stick(axis, place) => self.sticks[axis as usize] = place.clamp(-1.0, 1.0),
            PadEvent::Trigger(side, place) => {
                self.triggers[side as usize] = place.clamp(0.0, 1.0);
            }
            PadEvent::Key(key, held) => self.keys[key as usize] = held,
        }
        Ok(())
    }

    /// What the hand does.
    pub fn controls(&self) -> Controls {
        let stick = |axis: Axis| self.sticks[axis as usize];
        let held = |key: Key| self.keys[key as usize];
        // A cross is four buttons or two axes, and the other of the two rests.
        let cross = |axis, plus, minus| {
            let buttons = f64::from(i8::from(held(plus)) - i8::from(held(minus)));
            (buttons + stick(axis)).clamp(-1.0, 1.0)
        };
        let bits = [
            held(Key::South) || held(Key::RightShoulder),
            held(Key::East) || held(Key::LeftShoulder),
            held(Key::West),
            held(Key::North),
            held(Key::Select),
            held(Key::Start),
        ];
        let bits = bits
            .iter()
            .enumerate()
            .fold(0, |bits, (i, held)| bits | u32::from(*held) << i);
        Controls {
            push: Vector3::new(stick(Axis::LeftX), stick(Axis::LeftY), stick(Axis::RightY)),
            twist: Vector3::new(
                -cross(Axis::CrossY, Key::CrossUp, Key::CrossDown),
                cross(Axis::CrossX, Key::CrossRight, Key::CrossLeft),
                -stick(Axis::RightX),
            ),
            buttons: Buttons::from_bits(bits),
            gripper: Some(1.0 - self.triggers[0].max(self.triggers[1])),
        }
    }
}
