//! Strokes of a blade and their validation.

use crate::{Shape, Topology, Vec3, to_rest};

/// Most blade points of one stroke; at 1 mm of path each, four metres.
pub const BLADE_POINTS_MAX: usize = 4096;
/// Longest path of one stroke in m. Longer ones are several strokes.
pub const STROKE_LENGTH_MAX_M: f64 = 4.0;
/// Deepest blade in m; no scalpel is longer.
pub const BLADE_DEPTH_MAX_M: f64 = 0.5;
/// Widest wound a stroke may ask for in m.
pub const WOUND_WIDTH_MAX_M: f64 = 0.02;
/// Largest swept surface in squares of the lattice spacing; it bounds the time of one cut.
const SWEPT_SQUARES_MAX: f64 = 1e6;
/// Shortest step between blade points in m; a shorter one has no direction worth the name.
const STEP_MIN_M: f64 = 1e-7;

/// The blade at one moment, in the rest frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BladePoint {
    /// The deepest point of the blade's edge in m.
    pub tip: Vec3,
    /// Unit vector from the tip out along the blade, against the depth.
    pub axis: Vec3,
    /// Cutting length of the blade, from the tip along the axis, in m.
    pub depth_m: f64,
}

impl BladePoint {
    /// Upper end of the cutting part, in m.
    pub fn top(&self) -> Vec3 {
        self.tip + self.axis * self.depth_m
    }

    /// Tip and top.
    pub(crate) fn ends(&self) -> [Vec3; 2] {
        [self.tip, self.top()]
    }

    /// The same blade mapped from the deformed shape to the rest frame, by the local gradient of
    /// the deformation at its tip; `None` when the tip is not in the tissue or close to it.
    pub fn to_rest(&self, topology: &Topology, shape: &Shape) -> Option<Self> {
        let at = to_rest(topology, shape, self.tip)?;
        let blade = at.frame * self.axis * self.depth_m;
        let depth_m = blade.norm();
        (depth_m > 0.0 && depth_m.is_finite()).then(|| Self {
            tip: at.position,
            axis: blade / depth_m,
            depth_m,
        })
    }
}

/// One stroke of a blade in the rest frame: it sweeps the ribbon between the path of its tip and
/// the path of its top.
#[derive(Debug, Clone, PartialEq)]
pub struct CutStroke {
    /// The blade along its way; 2 to [`BLADE_POINTS_MAX`].
    pub points: Vec<BladePoint>,
    /// Width w0 of the wound at its top at rest in m, 0 for a closed cut. The rest positions follow
    /// it up to a tenth of the spacing; what a wound gapes beyond that, the tissue does by itself.
    pub width_m: f64,
}

impl CutStroke {
    /// Rejects impossible strokes, with the reason.
    pub(crate) fn check(&self, spacing: f64) -> Result<(), String> {
        let count = self.points.len();
        if !(2..=BLADE_POINTS_MAX).contains(&count) {
            return Err(format!(
                "a stroke has 2 to {BLADE_POINTS_MAX} blade points; this one has {count}"
            ));
        }
        for (index, p) in self.points.iter().enumerate() {
            let finite = p.tip.iter().chain(p.axis.iter()).all(|v| v.is_finite());
            if !finite || p.tip.amax() > 1e6 {
                return Err(format!(
                    "blade point {index} of the stroke has a coordinate that is not finite or too large"
                ));
            }
            if (p.axis.norm() - 1.0).abs() > 1e-3 {
                return Err(format!(
                    "the axis of blade point {index} is not a unit vector"
                ));
            }
            if !(p.depth_m > 0.0 && p.depth_m <= BLADE_DEPTH_MAX_M) {
                return Err(format!(
                    "blade point {index} is {} m deep; it must be above 0 and at most {BLADE_DEPTH_MAX_M} m",
                    p.depth_m
                ));
            }
        }
        if !(0.0..=WOUND_WIDTH_MAX_M).contains(&self.width_m) {
            return Err(format!(
                "the wound is {} m wide; it must be 0 to {WOUND_WIDTH_MAX_M} m",
                self.width_m
            ));
        }
        self.check_path(spacing)
    }

    fn check_path(&self, spacing: f64) -> Result<(), String> {
        let mut length_m = 0.0;
        let mut swept = 0.0;
        for (index, pair) in self.points.windows(2).enumerate() {
            let step = pair[1].tip - pair[0].tip;
            if step.norm() < STEP_MIN_M {
                return Err(format!(
                    "the blade does not move between its points {index} and {}; leave one out",
                    index + 1
                ));
            }
            length_m += step.norm();
            let tops = pair[1].top() - pair[0].top();
            let depth = pair[0].depth_m.max(pair[1].depth_m);
            let across = |v: Vec3| v.cross(&pair[0].axis).norm();
            swept += depth * (across(step) + across(tops)) / 2.0;
        }
        if length_m > STROKE_LENGTH_MAX_M {
            return Err(format!(
                "the stroke is {length_m} m long, more than {STROKE_LENGTH_MAX_M} m; make several of it"
            ));
        }
        if swept < 1e-6 * spacing * spacing {
            return Err(
                "the blade moves along its own axis and sweeps no surface; move it sideways".into(),
            );
        }
        if swept > SWEPT_SQUARES_MAX * spacing * spacing {
            return Err(format!(
                "the stroke sweeps {swept} m², too much for a lattice as fine as this; make several of it"
            ));
        }
        Ok(())
    }
}
