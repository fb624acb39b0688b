//! Where the tool is meant to be, after what happened to the pointer.
//!
//! The tool is under the pointer, at the depth that it had: it moves in the plane that lies across the view through it.
//! The wheel moves it along the line of sight. With [`Modifiers::FINE`] it moves a part of that way, with
//! [`Modifiers::TURN`] it turns instead, and comes off the pointer in both; it is under it again after the pointer left
//! the view and came back.

use nalgebra::{UnitQuaternion, Vector3};

use super::{Modifiers, PointerEvent, View};
use crate::{Buttons, Pose, Workspace};

/// The part of a movement that counts while [`Modifiers::FINE`] is held.
pub const FINE: f64 = 0.2;

/// How far the tool turns while [`Modifiers::TURN`] is held, rad per metre on the view plane: a turn in 31 cm. A metre
/// of wheel rolls it as far.
pub const TURN_RAD_PER_M: f64 = 20.0;

/// What a pointer wants of a tool.
#[derive(Debug, Clone)]
pub struct Aim {
    workspace: Workspace,
    goal: Pose,
    buttons: Buttons,
    /// The point under the pointer at the tool's depth, m; `None` while the pointer is elsewhere. It may be outside the
    /// workspace: whoever comes back from there finds the tool under the pointer.
    under: Option<Vector3<f64>>,
    /// How far the tool is off that point, m.
    off: Vector3<f64>,
}

impl Aim {
    /// A tool at `start`, or the place of the workspace nearest to it, with the pointer elsewhere.
    pub fn new(workspace: Workspace, start: Pose) -> Self {
        Self {
            workspace,
            goal: Pose {
                position: within(&workspace, start.position),
                ..start
            },
            buttons: Buttons::NONE,
            under: None,
            off: Vector3::zeros(),
        }
    }

    /// Where the tool is meant to be.
    pub fn goal(&self) -> &Pose {
        &self.goal
    }

    /// The buttons held.
    pub fn buttons(&self) -> Buttons {
        self.buttons
    }

    /// The pointer is gone: no button is held, and the tool is meant to be at `here`.
    pub fn leave(&mut self, here: Pose) {
        self.goal = here;
        self.buttons = Buttons::NONE;
        self.under = None;
    }

    /// Takes in an event whose numbers can be, with the pointer at `at` in the view. It presses no button unless
    /// `may_press`.
    pub fn take(&mut self, event: &PointerEvent, at: [f64; 2], may_press: bool) {
        self.buttons = if may_press {
            event.buttons
        } else {
            // What was held and still is.
            Buttons::from_bits(event.buttons.bits() & self.buttons.bits())
        };
        let view = &event.view;
        let turns = event.modifiers.contains(Modifiers::TURN);
        let share = if event.modifiers.contains(Modifiers::FINE) {
            FINE
        } else {
            1.0
        };
        let wheel = if turns { 0.0 } else { event.wheel_m };
        let before = self.under;
        let depth = view.depth(&before.unwrap_or(self.goal.position));
        let mut under = view.point(at, in_sight(view, depth + wheel));
        let moved = before.map_or(Vector3::zeros(), |before| under - before);
        if before.is_none() {
            self.off = Vector3::zeros();
        }
        if turns {
            self.off -= moved;
            // To the right turns about what is up, up about what is to the left, as if the pointer rolled it.
            let by = view.up * moved.dot(&view.right) - view.right * moved.dot(&view.up)
                + view.forward() * event.wheel_m;
            let turn = UnitQuaternion::from_scaled_axis(by * (TURN_RAD_PER_M * share));
            let turned = turn * self.goal.orientation;
            self.goal.orientation = UnitQuaternion::new_normalize(turned.into_inner());
        } else {
            self.off -= moved * (1.0 - share);
        }
        let free = under + self.off;
        let goal = within(&self.workspace, free);
        // A wheel that is turned on at the wall must not have to be turned back as far.
        let beyond = view.depth(&free) - view.depth(&goal);
        if beyond * wheel > 0.0 {
            let back = beyond.clamp(-wheel.abs(), wheel.abs());
            under = view.point(at, in_sight(view, view.depth(&under) - back));
        }
        self.under = Some(under);
        self.goal.position = goal;
    }
}

fn within(workspace: &Workspace, point: Vector3<f64>) -> Vector3<f64> {
    point.sup(&workspace.min).inf(&workspace.max)
}

/// A depth that can be seen: nothing behind the eye can, and close to it a movement would be none.
fn in_sight(view: &View, depth: f64) -> f64 {
    view.eye_m.map_or(depth, |eye| depth.max(-0.9 * eye))
}
