//! What the hand does, on its way from the driver's thread to the force loop.

use nalgebra::Vector3;
use triple_buffer::{Input, Output, triple_buffer};

use crate::Buttons;

/// What a hand does to a cap or to sticks. Plain data that crosses threads whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Controls {
    /// How far it pushes along the scene's axes: x to the right, y away from the hand, z up; 1 is all the way.
    pub push: Vector3<f64>,
    /// How far it twists about the same axes, right-handed; 1 is all the way.
    pub twist: Vector3<f64>,
    /// The buttons held.
    pub buttons: Buttons,
    /// Opening of a gripper from 0 (shut) to 1 (open), where there is something to shut it with.
    pub gripper: Option<f64>,
}

impl Controls {
    /// Nothing is touched.
    pub const NEUTRAL: Self = Self {
        push: Vector3::new(0.0, 0.0, 0.0),
        twist: Vector3::new(0.0, 0.0, 0.0),
        buttons: Buttons::NONE,
        gripper: None,
    };

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.push
            .iter()
            .chain(&self.twist)
            .chain(&self.gripper)
            .all(|c| c.is_finite())
    }
}

/// All that the driver's thread has to say.
#[derive(Debug, Clone, Copy)]
pub(super) struct State {
    pub(super) controls: Controls,
    /// Whether the device is there.
    pub(super) present: bool,
    /// Messages about the deflection so far.
    pub(super) heard: u64,
    /// Messages so far that made no sense.
    pub(super) garbled: u64,
}

/// The end of the driver's thread.
pub(super) struct Teller {
    state: State,
    line: Input<State>,
}

/// A line from a driver's thread to the force loop, on which the newest state is always at hand.
pub(super) fn line() -> (Teller, Output<State>) {
    let state = State {
        controls: Controls::NEUTRAL,
        present: true,
        heard: 0,
        garbled: 0,
    };
    let (line, heard) = triple_buffer(&state);
    (Teller { state, line }, heard)
}

impl Teller {
    /// The hand does something else now, or still the same.
    pub(super) fn tell(&mut self, controls: Controls) {
        self.state.controls = controls;
        self.state.heard += 1;
        self.line.write(self.state);
    }

    /// Something came that made no sense.
    pub(super) fn garbled(&mut self) {
        self.state.garbled += 1;
        self.line.write(self.state);
    }

    /// The device is there, or is not; nobody touches it in the moment in which that changes.
    pub(super) fn present(&mut self, present: bool) {
        self.state.present = present;
        self.state.controls = Controls::NEUTRAL;
        self.line.write(self.state);
    }
}

impl Drop for Teller {
    /// A thread that ended, if by a panic, no longer knows what the hand does.
    fn drop(&mut self) {
        self.present(false);
    }
}
