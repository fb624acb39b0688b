//! State of a gamepad, accumulated from events.

use nalgebra::Vector3;

use crate::Buttons;
use crate::backend::steered::Controls;

/// An axis of a stick, or of a cross that reports like a stick.
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

/// A button, named by its position, because labels differ.
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

const KEYS: usize = 12;

/// An event of a gamepad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PadEvent {
    /// Position of a stick along one axis, −1 to 1.
    Stick(Axis, f64),
    /// Position of a trigger, 0 to 1.
    Trigger(Trigger, f64),
    /// A button is pressed or released.
    Key(Key, bool),
}

/// State of a gamepad.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pad {
    sticks: [f64; AXES],
    triggers: [f64; 2],
    keys: [bool; KEYS],
}

/// A non-finite position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the gamepad reported a non-finite position; unplug it and plug it in again")]
pub struct NoNumber;

impl Pad {
    /// Applies an event. A number out of range is clamped.
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

    /// The present controls.
    pub fn controls(&self) -> Controls {
        let stick = |axis: Axis| self.sticks[axis as usize];
        let held = |key: Key| self.keys[key as usize];
        // A cross reports four buttons or two axes; the other kind stays neutral.
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
