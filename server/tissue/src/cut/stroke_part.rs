//! Strokes in parts: a cut that extends while the blade moves.

use std::sync::Arc;

use super::stroke::{BladePoint, CutStroke};

/// Length of the path before a part that is cut once more with it, in spacings. Faces at the front of a sheet stay
/// closed until the blade is past them, and the nodes there need the direction of the path.
const OVERLAP: f64 = 3.0;

/// A whole stroke, or the part of it that the blade has made since the part before.
#[derive(Debug, Clone, PartialEq)]
pub struct StrokePart {
    /// The new path, in the rest frame. With [`joins`](Self::joins) it begins after the last point of the part before.
    pub path: CutStroke,
    /// The stroke that it belongs to; `None` for a whole stroke. Parts of one stroke are undone together.
    pub stroke: Option<u64>,
    /// Whether the blade moved here from the last point of the part before, which must be in effect.
    pub joins: bool,
}

impl From<&CutStroke> for StrokePart {
    fn from(stroke: &CutStroke) -> Self {
        Self {
            path: stroke.clone(),
            stroke: None,
            joins: false,
        }
    }
}

impl StrokePart {
    /// Whether both are parts of one stroke.
    pub(crate) fn is_of_stroke(&self, other: &Self) -> bool {
        self.stroke.is_some() && self.stroke == other.stroke
    }

    /// The blade at the end of the parts before it, from where it moved on; `None` for the first part.
    pub(crate) fn joint(&self, before: &[Arc<Self>]) -> Option<BladePoint> {
        let mut earlier = before.iter().rev().filter(|part| part.is_of_stroke(self));
        let last = self.joins.then(|| earlier.next())??;
        last.path.points.last().copied()
    }

    /// The path to cut: with the end of the parts before it, oldest first.
    pub(crate) fn with_overlap(&self, before: &[Arc<Self>], spacing: f64) -> CutStroke {
        let mut points: Vec<BladePoint> = self.path.points.iter().rev().copied().collect();
        if self.joins {
            let mut left_m = OVERLAP * spacing;
            let earlier = before.iter().rev().filter(|part| part.is_of_stroke(self));
            'parts: for part in earlier {
                for point in part.path.points.iter().rev() {
                    if left_m <= 0.0 {
                        break 'parts;
                    }
                    if let Some(next) = points.last() {
                        left_m -= (next.tip - point.tip).norm();
                    }
                    points.push(*point);
                }
                if !part.joins {
                    break;
                }
            }
        }
        points.reverse();
        CutStroke {
            points,
            width_m: self.path.width_m,
        }
    }
}
