//! State of the cap, accumulated from messages.

use nalgebra::Vector3;

use super::Report;
use crate::backend::steered::Controls;

/// A cap and its buttons.
#[derive(Debug, Clone, Copy)]
pub struct Cap(Controls);

impl Default for Cap {
    /// No deflection.
    fn default() -> Self {
        Self(Controls::NEUTRAL)
    }
}

impl Cap {
    /// Applies a message; returns the present controls.
    pub fn take(&mut self, report: Report) -> Controls {
        match report {
            Report::Push(push) => self.0.push = to_scene(push),
            Report::Twist(twist) => self.0.twist = to_scene(twist),
            Report::Both { push, twist } => {
                self.0.push = to_scene(push);
                self.0.twist = to_scene(twist);
            }
            Report::Buttons(buttons) => self.0.buttons = buttons,
        }
        self.0
    }
}

/// Half a turn about x: from right, towards the user, down to right, away, up.
fn to_scene(v: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(v.x, -v.y, -v.z)
}
