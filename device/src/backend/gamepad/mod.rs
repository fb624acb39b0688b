//! Gamepads: sticks steer the tool, triggers close a gripper, and rumble signals contact.
//!
//! | | the tool |
//! | --- | --- |
//! | left stick | right, left, away and towards the hand |
//! | right stick, up and down | up and down |
//! | right stick, sideways | turns about the vertical, clockwise from above to the right |
//! | cross, sideways | turns about the axis that points away from the hand, clockwise to the right |
//! | cross, up and down | tilts about the axis to the right: up tilts the top away from the hand |
//! | triggers | shut a gripper, by the one that is pressed farther |
//! | lower button of the four, right shoulder | the main button |
//! | right button of the four, left shoulder | the second button |
//! | left and upper button of the four, select, start | buttons 3 to 6 |
//!
//! The shoulders double the two main buttons, because the thumbs are on the sticks. Rumble is a cue, not a force,
//! so the device renders none: see [`Rumble`] for its law.
//!
//! - [`PadEvent`], [`Pad`]: events of a gamepad, and the resulting controls.
//! - [`Port`]: where events come from. The hardware's port is built with the feature `gamepad`.

mod pad;
#[cfg(feature = "gamepad")]
mod system;
#[cfg(test)]
mod tests;

use std::time::Duration;

use super::steered::{DeviceLost, Kind, RateControl, Rumble, Source, SourceEvent, Space, Steered};
use crate::OpenError;

pub use pad::{Axis, Key, Pad, PadEvent, Trigger};
#[cfg(feature = "gamepad")]
pub use system::open;

/// Source of gamepad events.
pub trait Port: Send {
    /// Waits at most `patience` for the next event.
    fn event(&mut self, patience: Duration) -> Result<Option<PadEvent>, DeviceLost>;

    /// Looks once, without waiting, for the lost gamepad; returns whether it is back.
    fn reopen(&mut self) -> bool;

    /// Shakes with this strength, 0 to 1, until the next call; nothing on pads without motors.
    fn rumble(&mut self, strength: f32);
}

/// Rate control of sticks: their centre is less exact than that of a 6-DOF cap.
pub fn rate() -> RateControl {
    RateControl {
        dead_zone: 0.15,
        ..RateControl::default()
    }
}

/// Steers a tool in `space` with the gamepad behind `port`, which is called `name`.
pub fn over(
    port: impl Port + 'static,
    name: String,
    rate: RateControl,
    space: &Space,
) -> Result<Steered, OpenError> {
    let kind = Kind {
        name,
        // Position, turn and gripper.
        dof_in: 7,
        // A stick that is held still sends no events.
        silence_max_us: None,
        rate,
        rumble: Some(Rumble::default()),
    };
    let listener = Listener {
        port,
        pad: Pad::default(),
    };
    Steered::open(Box::new(listener), kind, space)
}

/// A port and the state of its gamepad.
struct Listener<P> {
    port: P,
    pad: Pad,
}

impl<P: Port> Source for Listener<P> {
    fn listen(&mut self, patience: Duration) -> Result<SourceEvent, DeviceLost> {
        let event = self.port.event(patience)?;
        Ok(event.map_or(SourceEvent::Quiet, |event| {
            self.pad.take(event).map_or(SourceEvent::Garbled, |()| {
                SourceEvent::Controls(self.pad.controls())
            })
        }))
    }

    fn reopen(&mut self) -> bool {
        self.pad = Pad::default();
        self.port.reopen()
    }

    fn hint(&mut self, strength: f32) {
        self.port.rumble(strength);
    }
}
