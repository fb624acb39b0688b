//! What happens to a pointer, and the view in which it happens.

use nalgebra::Vector3;

use crate::{Buttons, DeviceTime};

/// How far from the origin anything of an event may be, m. Beyond it is as good as no number.
const FAR_M: f64 = 1e3;

/// How a view looks at the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// A point of the view plane, m: the middle of the picture.
    pub centre: Vector3<f64>,
    /// To the right in the picture; a unit vector.
    pub right: Vector3<f64>,
    /// Up in the picture; a unit vector across `right`.
    pub up: Vector3<f64>,
    /// How far before the view plane the eye is, m, in a view with perspective; `None` for one without.
    pub eye_m: Option<f64>,
}

impl View {
    /// The direction in which it looks.
    pub fn forward(&self) -> Vector3<f64> {
        self.up.cross(&self.right)
    }

    /// The line of sight through a place on the view plane (m to the right, m up): a point of it, and its direction
    /// per metre of depth.
    pub fn sight(&self, at: [f64; 2]) -> (Vector3<f64>, Vector3<f64>) {
        let on_plane = self.right * at[0] + self.up * at[1];
        let along = match self.eye_m {
            Some(eye) => self.forward() + on_plane / eye,
            None => self.forward(),
        };
        (self.centre + on_plane, along)
    }

    /// The point at `depth_m` behind the view plane that is seen at this place.
    pub fn point(&self, at: [f64; 2], depth_m: f64) -> Vector3<f64> {
        let (from, along) = self.sight(at);
        from + along * depth_m
    }

    /// How far behind the view plane a point is, m.
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

/// Keys that change what a movement means, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Modifiers(u8);

impl Modifiers {
    /// None.
    pub const NONE: Self = Self(0);
    /// Movements and wheel count a part ([`FINE`](super::FINE)).
    pub const FINE: Self = Self(1);
    /// Movements turn the tool and leave it where it is; the wheel rolls it about the line of sight.
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

/// Something happens to the pointer, or to a key that stands for a button.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointerEvent {
    /// When, on the clock that the device is read with.
    pub time: DeviceTime,
    /// How the view looked at the scene then.
    pub view: View,
    /// Where the pointer is on the view plane, m to the right and m up of its centre; `None` when it left the view, or
    /// when what it did was cancelled: then the tool stays where it is and no button is held.
    pub at: Option<[f64; 2]>,
    /// How far the wheel turned since the last event, as depth: m away from the viewer.
    pub wheel_m: f64,
    /// The buttons held, those of the mouse and keys that stand for them.
    pub buttons: Buttons,
    /// The modifiers held.
    pub modifiers: Modifiers,
}

impl PointerEvent {
    /// Whether every number can be; one that leaves needs none.
    pub fn is_sound(&self) -> bool {
        self.at.is_none_or(|at| {
            at.iter().all(|c| c.abs() <= FAR_M)
                && self.wheel_m.abs() <= FAR_M
                && self.view.is_sound()
        })
    }
}
