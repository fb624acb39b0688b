//! When a cell is sound: the three edges at each of its corners span a volume (its corner Jacobian), and none of its
//! springs is too short.

use crate::Vec3;
use crate::cell::PAIRS;

/// Smallest volume spanned at a corner of a cell, in cubed spacings (1 for a cube). Lower lets
/// cuts come closer to a tilted blade where the lattice makes a step; higher keeps cells fatter.
pub(crate) const CORNER_FLOOR: f64 = 0.01;
/// Shortest spring, in spacings.
pub(crate) const SPRING_FLOOR: f64 = 0.3;

/// The worst of a cell.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Soundness {
    /// Smallest volume at a corner.
    pub(crate) volume: f64,
    /// Square of the shortest spring.
    pub(crate) spring: f64,
}

impl Soundness {
    pub(crate) fn of(corners: &[Vec3; 8]) -> Self {
        let volumes = (0..8).map(|c| span(corners, c));
        let springs = PAIRS.map(|[a, b]| (corners[b] - corners[a]).norm_squared());
        Self {
            volume: volumes.fold(f64::INFINITY, f64::min),
            spring: springs.into_iter().fold(f64::INFINITY, f64::min),
        }
    }

    pub(crate) fn min(&self, other: &Self) -> Self {
        Self {
            volume: self.volume.min(other.volume),
            spring: self.spring.min(other.spring),
        }
    }

    pub(crate) fn is_above(&self, floor: &Self) -> bool {
        self.volume >= floor.volume && self.spring >= floor.spring
    }
}

/// Volume spanned by the three edges at a corner of a cell.
pub(crate) fn span(corners: &[Vec3; 8], corner: usize) -> f64 {
    let edge = |axis: usize| {
        let out = corners[corner ^ (1 << axis)] - corners[corner];
        if corner >> axis & 1 == 0 { out } else { -out }
    };
    edge(0).cross(&edge(1)).dot(&edge(2))
}
