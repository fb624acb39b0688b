//! Controls of the hand, passed from the driver's thread to the force loop.

use nalgebra::Vector3;
use triple_buffer::{Input, Output, triple_buffer};

use crate::Buttons;

/// Deflections of a cap or of sticks. Plain data that is copied between threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Controls {
    /// Push along the scene's axes: x to the right, y away from the hand, z up; 1 is full deflection.
    pub push: Vector3<f64>,
    /// Twist about the same axes, right-handed; 1 is full deflection.
    pub twist: Vector3<f64>,
    /// The buttons held.
    pub buttons: Buttons,
    /// Opening of a gripper from 0 (shut) to 1 (open), where the device has a control for it.
    pub gripper: Option<f64>,
}

impl Controls {
    /// No deflection.
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

/// State published by the driver's thread.
#[derive(Debug, Clone, Copy)]
pub(super) struct State {
    pub(super) controls: Controls,
    /// Whether the device is connected.
    pub(super) present: bool,
    /// Number of messages about the deflection so far.
    pub(super) heard: u64,
    /// Number of invalid messages so far.
    pub(super) garbled: u64,
}

/// The driver thread's end.
pub(super) struct Publisher {
    state: State,
    line: Input<State>,
}

/// A triple buffer from a driver's thread to the force loop.
pub(super) fn line() -> (Publisher, Output<State>) {
    let state = State {
        controls: Controls::NEUTRAL,
        present: true,
        heard: 0,
        garbled: 0,
    };
    let (line, heard) = triple_buffer(&state);
    (Publisher { state, line }, heard)
}

impl Publisher {
    /// Publishes the present controls, changed or not.
    pub(super) fn publish(&mut self, controls: Controls) {
        self.state.controls = controls;
        self.state.heard += 1;
        self.line.write(self.state);
    }

    /// Counts an invalid message.
    pub(super) fn garbled(&mut self) {
        self.state.garbled += 1;
        self.line.write(self.state);
    }

    /// The device was connected or lost; the deflection becomes neutral.
    pub(super) fn present(&mut self, present: bool) {
        self.state.present = present;
        self.state.controls = Controls::NEUTRAL;
        self.line.write(self.state);
    }
}

impl Drop for Publisher {
    /// A thread that ended, even by a panic, no longer knows the controls.
    fn drop(&mut self) {
        self.present(false);
    }
}
