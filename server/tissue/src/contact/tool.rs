//! Tools: rigid, rounded, and turned as the hand turns them.

use nalgebra::UnitQuaternion;

use crate::Vec3;

/// Half the length of a tool at most, and the offset of its middle from the pivot at most, in m.
pub const TOOL_REACH_MAX_M: f64 = 1.0;

/// What a tool is within its radius of: in its own frame, whose origin is the pivot, every `mid + s half[0] +
/// t half[1]` with s and t from -1 to 1. Both halves zero: a ball. One: a needle, a handle, the edge of a blade. Two,
/// at right angles: a plate, the side of a blade, the jaw of a forceps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Form {
    /// Its middle from the pivot, in m.
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
        // A comparison with a number that is none is false.
        let across = a.dot(b).abs() <= 1e-6 * a.norm() * b.norm();
        within(&self.mid) && within(a) && within(b) && across
    }
}

/// A tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tool {
    /// Tells tools apart from step to step; two tools of one step have different ones.
    pub id: u32,
    /// The pivot, which a hand holds and torques are about, in m: the centre of a ball.
    pub centre: Vec3,
    /// Rotation from the tool's frame to the scene's.
    pub turn: UnitQuaternion<f64>,
    /// What it is within its radius of.
    pub form: Form,
    /// Radius in m, above zero.
    pub radius_m: f64,
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
        }
    }

    /// Whether pose, form and radius are numbers that mean something.
    pub fn is_sound(&self) -> bool {
        let norm = self.turn.quaternion().norm();
        self.radius_m > 0.0
            && self.radius_m.is_finite()
            && self.centre.iter().all(|v| v.abs() < 1e6)
            && (norm - 1.0).abs() < 1e-6
            && self.form.is_sound()
    }

    /// Whether it is a ball around its pivot, which turns without moving.
    pub(crate) fn is_ball(&self) -> bool {
        self.form == Form::BALL
    }
}
