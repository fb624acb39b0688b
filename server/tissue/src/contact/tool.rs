//! Tools: rigid rounded bodies with a pose.

use nalgebra::UnitQuaternion;

use crate::Vec3;

/// Maximum half length of a tool, and maximum offset of its middle from the pivot, in m.
pub const TOOL_REACH_MAX_M: f64 = 1.0;

/// The core of a tool in its own frame, whose origin is the pivot: every `mid + s half[0] + t half[1]` with s and t
/// from -1 to 1. Two zero halves: a ball. One: a needle, a handle, the edge of a blade. None: a plate, the side of a
/// blade, the jaw of a forceps; the halves are then at right angles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Form {
    /// Middle of the core relative to the pivot, in m.
    pub mid: Vec3,
    /// Half its length and half its width, with their directions, in m.
    pub half: [Vec3; 2],
}

impl Form {
    /// A ball around the pivot.
    pub const BALL: Self = Self {
        mid: Vec3::new(0.0, 0.0, 0.0),
        half: [Vec3::new(0.0, 0.0, 0.0); 2],
    };

    /// A line from one point to another.
    pub fn line(from: Vec3, to: Vec3) -> Self {
        Self {
            mid: (from + to) * 0.5,
            half: [(to - from) * 0.5, Vec3::zeros()],
        }
    }

    /// A rectangle around `mid`.
    pub const fn rectangle(mid: Vec3, half: [Vec3; 2]) -> Self {
        Self { mid, half }
    }

    fn is_sound(&self) -> bool {
        let [a, b] = &self.half;
        let within = |v: &Vec3| v.norm() <= TOOL_REACH_MAX_M;
        // A comparison with NaN is false.
        let across = a.dot(b).abs() <= 1e-6 * a.norm() * b.norm();
        within(&self.mid) && within(a) && within(b) && across
    }
}

/// The state of a sharp needle, whose tip is the end of its core against the first half axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Needle {
    /// Whether the tissue holds it: from the first touch of its tip on until it has left the surface.
    pub is_inserted: bool,
    /// Whether this shape decides on touch and withdrawal; `is_inserted` then counts in the first step only. In other
    /// shapes it is the decision of the site that holds the needle.
    pub decides: bool,
}

/// A tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tool {
    /// Identifies the tool from step to step; unique within a step.
    pub id: u32,
    /// The pivot in m: the grip point and the reference of torques; the centre of a ball.
    pub centre: Vec3,
    /// Rotation from the tool's frame to the scene's.
    pub turn: UnitQuaternion<f64>,
    /// Core of the tool.
    pub form: Form,
    /// Radius in m, above zero.
    pub radius_m: f64,
    /// `None` for a blunt tool.
    pub needle: Option<Needle>,
    /// Share of its contact force, from 0 to 1: a weaker tool withdraws along that force, by the rest of its indentation.
    /// An inserted needle does not.
    pub strength: f64,
}

impl Tool {
    /// A ball.
    pub fn ball(id: u32, centre: Vec3, radius_m: f64) -> Self {
        Self {
            id,
            centre,
            turn: UnitQuaternion::identity(),
            form: Form::BALL,
            radius_m,
            needle: None,
            strength: 1.0,
        }
    }

    /// Whether pose, form, radius and strength are finite and valid.
    pub fn is_sound(&self) -> bool {
        let norm = self.turn.quaternion().norm();
        self.radius_m > 0.0
            && self.radius_m.is_finite()
            && self.centre.iter().all(|v| v.abs() < 1e6)
            && (norm - 1.0).abs() < 1e-6
            && (0.0..=1.0).contains(&self.strength)
            && self.form.is_sound()
    }

    /// Whether it is a ball around its pivot, which turns without moving.
    pub(crate) fn is_ball(&self) -> bool {
        self.form == Form::BALL
    }
}
