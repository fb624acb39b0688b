//! Target pose of the tool, from pointer events.
//!
//! The tool is under the pointer at its present depth: it moves in the plane across the view. The wheel moves it
//! along the line of sight. [`Modifiers::FINE`] scales the movement down, and [`Modifiers::TURN`] turns the tool
//! instead; both offset it from the pointer. The offset ends when the pointer leaves the view and returns.

use nalgebra::{UnitQuaternion, Vector3};

use super::{Modifiers, PointerEvent, View};
use crate::{Buttons, Pose, Workspace};

/// Scale of movements while [`Modifiers::FINE`] is held.
pub const FINE: f64 = 0.2;

/// Rotation while [`Modifiers::TURN`] is held, rad per metre on the view plane: a turn in 31 cm. A metre of wheel
/// rolls the tool by the same angle.
pub const TURN_RAD_PER_M: f64 = 20.0;

/// Target pose of a pointer.
#[derive(Debug, Clone)]
pub struct Aim {
    workspace: Workspace,
    goal: Pose,
    buttons: Buttons,
    /// The point under the pointer at the tool's depth, m; `None` outside the view. It may be outside the
    /// workspace, so that a pointer that returns finds the tool under it.
    under: Option<Vector3<f64>>,
    /// Offset of the tool from that point, m.
    off: Vector3<f64>,
}

impl Aim {
    /// A tool at `start`, clamped to the workspace, with the pointer outside the view.
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

    /// The target pose.
    pub fn goal(&self) -> &Pose {
        &self.goal
    }

    /// The buttons held.
    pub fn buttons(&self) -> Buttons {
        self.buttons
    }

    /// The pointer is gone: no button is held, and the target becomes `here`.
    pub fn leave(&mut self, here: Pose) {
        self.goal = here;
        self.buttons = Buttons::NONE;
        self.under = None;
    }

    /// Applies a valid event with the pointer at `at` in the view. It presses no button unless `may_press`.
    pub fn take(&mut self, event: &PointerEvent, at: [f64; 2], may_press: bool) {
        self.buttons = if may_press {
            event.buttons
        } else {
            // Buttons that were held and still are.
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
            // The rotation of a ball rolled by the pointer: right turns about up, up turns about left.
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
        // Wheel motion beyond the wall is dropped, so that the reverse motion acts at once.
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

/// A visible depth: in front of the eye, and far enough that movements have an effect.
fn in_sight(view: &View, depth: f64) -> f64 {
    view.eye_m.map_or(depth, |eye| depth.max(-0.9 * eye))
}
