//! Pointer events, and the view in which they occur.

use nalgebra::Vector3;

use crate::{Buttons, DeviceTime};

/// Maximum distance from the origin of any value of an event, m. A larger one is invalid.
const FAR_M: f64 = 1e3;

/// Geometry of a view on the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// A point of the view plane, m: the middle of the picture.
    pub centre: Vector3<f64>,
    /// To the right in the picture; a unit vector.
    pub right: Vector3<f64>,
    /// Up in the picture; a unit vector across `right`.
    pub up: Vector3<f64>,
    /// Distance of the eye in front of the view plane, m, in perspective; `None` for a parallel view.
    pub eye_m: Option<f64>,
}

impl View {
    /// The viewing direction.
    pub fn forward(&self) -> Vector3<f64> {
        self.up.cross(&self.right)
    }

    /// The line of sight through a position on the view plane (m to the right, m up): a point of it, and its
    /// direction per metre of depth.
    pub fn sight(&self, at: [f64; 2]) -> (Vector3<f64>, Vector3<f64>) {
        let on_plane = self.right * at[0] + self.up * at[1];
        let along = match self.eye_m {
            Some(eye) => self.forward() + on_plane / eye,
            None => self.forward(),
        };
        (self.centre + on_plane, along)
    }

    /// The point at `depth_m` behind the view plane that is seen at `at`.
    pub fn point(&self, at: [f64; 2], depth_m: f64) -> Vector3<f64> {
        let (from, along) = self.sight(at);
        from + along * depth_m
    }

    /// Depth of a point behind the view plane, m.
    pub fn depth(&self, point: &Vector3<f64>) -> f64 {
        (point - self.centre).dot(&self.forward())
    }

    fn is_sound(&self) -> bool {
        let near = |a: f64, b: f64| (a - b).abs() < 1e-3;
        self.centre.iter().all(|c| c.abs() <= FAR_M)
            && near(self.right.norm(), 1.0)
            && near(self.up.norm(), 1.0)
            && near(self.right.dot(&self.up), 0.0)
            && self.eye_m.is_none_or(|eye| (1e-3..=FAR_M).contains(&eye))
    }
}

/// Modifier keys, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Modifiers(u8);

impl Modifiers {
    /// None.
    pub const NONE: Self = Self(0);
    /// Movements and wheel are scaled by [`FINE`](super::FINE).
    pub const FINE: Self = Self(1);
    /// Movements turn the tool in place; the wheel rolls it about the line of sight.
    pub const TURN: Self = Self(1 << 1);

    /// These and `other`.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Whether all of `other` are held.
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// An event of the pointer, or of a key that acts as a button.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointerEvent {
    /// Time, on the device's clock.
    pub time: DeviceTime,
    /// The view at that time.
    pub view: View,
    /// Position on the view plane, m to the right and m up of its centre. `None` after leaving the view or a
    /// cancelled gesture: the tool keeps its pose and no button is held.
    pub at: Option<[f64; 2]>,
    /// Wheel motion since the last event, as depth: m away from the viewer.
    pub wheel_m: f64,
    /// The buttons held, from the mouse and from keys that act as buttons.
    pub buttons: Buttons,
    /// The modifiers held.
    pub modifiers: Modifiers,
}

impl PointerEvent {
    /// Whether every number is valid; an event that leaves needs none.
    pub fn is_sound(&self) -> bool {
        self.at.is_none_or(|at| {
            at.iter().all(|c| c.abs() <= FAR_M)
                && self.wheel_m.abs() <= FAR_M
                && self.view.is_sound()
        })
    }
}
