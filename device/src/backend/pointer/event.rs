//! Pointer events.

use crate::{Buttons, DeviceTime, Pose};

/// Maximum distance of a goal from the origin along an axis, m. A larger one is invalid.
const FAR_M: f64 = 1e3;

/// Maximum difference of a rotation's norm from 1: views compute in single precision.
const NORM_ERROR_MAX: f64 = 1e-3;

/// An event of mouse, touch or keyboard.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointerEvent {
    /// Time, on the device's clock.
    pub time: DeviceTime,
    /// Target pose of the tool, in the frame of the scene. `None` after the pointer left or the view is gone: the
    /// tool keeps its pose and no button is held.
    pub goal: Option<Pose>,
    /// The buttons held, from the mouse and from keys that act as buttons.
    pub buttons: Buttons,
}

impl PointerEvent {
    /// Whether the goal is finite, within 1 km of the origin, and its rotation has norm 1.
    pub fn is_sound(&self) -> bool {
        self.goal.is_none_or(|goal| {
            goal.position.iter().all(|c| c.abs() <= FAR_M)
                && (goal.orientation.coords.norm() - 1.0).abs() <= NORM_ERROR_MAX
        })
    }
}
