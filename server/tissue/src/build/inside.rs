//! Which region holds a point.
//!
//! One watertight line per surface, along the axis that its triangles face most. The tree keeps
//! vertices in single precision, all copies of one rounded alike, so the surface stays closed.

use rayon::prelude::*;

use super::bvh::Bvh;
use super::rays::{Winding, hit_at};
use crate::{Surface, Vec3};

/// Answers which region holds a point.
#[derive(Debug)]
pub(super) struct PointQuery {
    surfaces: Vec<(Bvh, usize)>,
}

impl PointQuery {
    /// Sorts the triangles of all surfaces into trees about `middle`.
    pub(super) fn new(surfaces: &[&Surface], middle: Vec3) -> Self {
        let tree = |s: &&Surface| {
            let flat = (0..s.triangles.len()).map(|t| Bvh::flat(&middle, &s.corners(t)));
            (Bvh::new(middle, flat.collect()), facing(s))
        };
        Self {
            surfaces: surfaces.par_iter().map(tree).collect(),
        }
    }

    /// The region at a point, overlaps resolved, or `None` outside all of them.
    pub(super) fn region_at(&self, point: Vec3) -> Option<usize> {
        (0..self.surfaces.len())
            .rev()
            .find(|&r| self.contains(r, point))
    }

    /// Whether region `r`'s own surface contains the point, whoever else does.
    pub(super) fn contains(&self, region: usize, point: Vec3) -> bool {
        let (tree, axis) = &self.surfaces[region];
        if !tree.may_contain(&point) {
            return false;
        }
        let mut winding = Winding::default();
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        tree.for_line(&point, *axis, |at, corners| {
            if let Some(hit) = hit_at(corners, *axis, [at[u], at[v]]) {
                winding.add(hit.turn, hit.depth < at[*axis]);
            }
        });
        winding.is_inside()
    }
}

/// The axis along which the surface shows the largest area.
fn facing(surface: &Surface) -> usize {
    let mut shown = Vec3::zeros();
    for t in 0..surface.triangles.len() {
        let [a, b, c] = surface.corners(t);
        shown += (b - a).cross(&(c - a)).abs();
    }
    // A tie goes to z, the axis of the first rays.
    [1, 0].into_iter().fold(2, |best, axis| {
        if shown[axis] > shown[best] {
            axis
        } else {
            best
        }
    })
}
