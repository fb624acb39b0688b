//! Point location: the region that contains a point.
//!
//! Far from a surface its occupancy grid decides. Near it one watertight ray decides, along the axis that its
//! triangles face most. The tree keeps vertices in single precision, with all copies of a vertex rounded alike, so the
//! surface stays closed.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bvh::{Bvh, LineSide};
use super::occupancy_grid::OccupancyGrid;
use super::rays::{Winding, along_ray, hit_at, inside};
use crate::Surface;

/// Finds the region that contains a point.
#[derive(Debug)]
pub(super) struct PointQuery {
    surfaces: Vec<Body>,
}

/// One surface.
#[derive(Debug)]
struct Body {
    tree: Bvh,
    /// Axis of its lines.
    axis: usize,
    /// Whether its triangles are wound consistently, so that every line leaves it as often as it enters.
    wound_alike: bool,
    occupancy: OccupancyGrid,
}

impl PointQuery {
    /// Sorts the triangles of all surfaces into trees about `middle`, and classifies the space on a
    /// lattice of this spacing (m).
    pub(super) fn new(surfaces: &[&Surface], middle: Vec3, spacing: f64) -> Self {
        let body = |surface: &&Surface| {
            let corners = |t| surface.corners(t);
            let flat = (0..surface.triangles.len()).map(|t| Bvh::flat(&middle, &corners(t)));
            let mut body = Body {
                tree: Bvh::new(middle, flat.collect()),
                axis: facing(surface),
                wound_alike: is_wound_alike(surface),
                occupancy: OccupancyGrid::default(),
            };
            body.occupancy = OccupancyGrid::new(surface, spacing, |p| body.contains(p));
            body
        };
        Self {
            surfaces: surfaces.par_iter().map(body).collect(),
        }
    }

    /// The region at a point, overlaps resolved, or `None` outside all of them.
    pub(super) fn region_at(&self, point: Vec3) -> Option<usize> {
        (0..self.surfaces.len())
            .rev()
            .find(|&r| self.contains(r, point))
    }

    /// Number of regions.
    pub(super) fn regions(&self) -> usize {
        self.surfaces.len()
    }

    /// The stretches of the line along `axis` through a point that lie inside region `r`'s own surface, regardless of other
    /// regions, from low to high.
    pub(super) fn inside_along(&self, region: usize, point: Vec3, axis: usize) -> Vec<[f64; 2]> {
        self.surfaces[region].inside_along(point, axis)
    }

    /// Whether region `r`'s own surface contains the point, regardless of other regions.
    pub(super) fn contains(&self, region: usize, point: Vec3) -> bool {
        self.surfaces[region].contains(point)
    }
}

impl Body {
    fn contains(&self, point: Vec3) -> bool {
        if !self.tree.may_contain(&point) {
            return false;
        }
        let known = self.occupancy.contains(&point);
        known.unwrap_or_else(|| self.ray_contains(point))
    }

    fn inside_along(&self, point: Vec3, axis: usize) -> Vec<[f64; 2]> {
        let sides = [(axis + 1) % 3, (axis + 2) % 3];
        let mut hits = Vec::new();
        self.tree
            .for_line(&point, axis, LineSide::Both, |at, corners| {
                if let Some(mut hit) = hit_at(corners, axis, sides.map(|a| at[a])) {
                    hit.depth += point[axis] - at[axis];
                    hits.push(hit);
                }
            });
        hits.sort_by(along_ray);
        let mut stretches = Vec::new();
        inside(&hits, |from, to| stretches.push([from, to]));
        stretches
    }

    fn ray_contains(&self, point: Vec3) -> bool {
        let axis = self.axis;
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let hits = |way: LineSide, each: &mut dyn FnMut(i8, bool)| {
            self.tree.for_line(&point, axis, way, |at, corners| {
                if let Some(hit) = hit_at(corners, axis, [at[u], at[v]]) {
                    each(hit.turn, hit.depth < at[axis]);
                }
            });
        };
        if self.wound_alike {
            // The hits on either side of the point give the same answer.
            let way = self.tree.nearer_end(&point, axis);
            let mut turns = 0;
            hits(way, &mut |turn, before| {
                if before == (way == LineSide::Before) {
                    turns += i32::from(turn);
                }
            });
            return turns != 0;
        }
        let mut winding = Winding::default();
        hits(LineSide::Both, &mut |turn, before| {
            winding.add(turn, before);
        });
        winding.is_inside()
    }
}

/// Whether every edge is used as often in one direction as in the other. Each undirected edge gets a
/// pseudo-random number, and those of forward uses must cancel those of backward uses. A false match happens
/// once in 2^64 surfaces.
fn is_wound_alike(surface: &Surface) -> bool {
    let mut sum = 0_u64;
    for &[a, b, c] in &surface.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let edge = u64::from(from.min(to)) << 32 | u64::from(from.max(to));
            let mut number = edge.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            number = (number ^ (number >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
            number ^= number >> 32;
            sum = if from < to {
                sum.wrapping_add(number)
            } else {
                sum.wrapping_sub(number)
            };
        }
    }
    sum == 0
}

/// The axis along which the surface shows the largest area.
pub(super) fn facing(surface: &Surface) -> usize {
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

#[cfg(test)]
mod tests {
    use super::super::tests::turned;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        /// A spindle with ridges: voxels of any size agree with the lines, or are undecided.
        #[test]
        fn occupancy_agrees_with_rays(
            radii in prop::collection::vec(0.005_f64..0.03, 2..9), spacing in 5e-4_f64..0.02,
            points in prop::collection::vec(prop::array::uniform3(-0.035_f64..0.035), 64),
        ) {
            let profile: Vec<(f64, f64)> =
                radii.iter().zip(0..).map(|(&r, i)| (r, f64::from(i) * 8e-3 - 0.03)).collect();
            let surface = turned(&profile, 24);
            let query = PointQuery::new(&[&surface], Vec3::zeros(), spacing);
            let body = &query.surfaces[0];
            for point in points.into_iter().map(Vec3::from) {
                prop_assert_eq!(body.contains(point), body.ray_contains(point), "{}", point);
            }
        }
    }

    #[test]
    fn inverted_triangle_is_detected_and_keeps_the_result() {
        let mut surface = turned(&[(0.02, -0.03), (0.02, 0.03)], 64);
        assert!(is_wound_alike(&surface));
        surface.triangles[0].swap(0, 1);
        assert!(!is_wound_alike(&surface));
        let query = PointQuery::new(&[&surface], Vec3::zeros(), 1.0);
        for (x, inside) in [(0.0, true), (0.019, true), (0.0205, false)] {
            assert_eq!(query.contains(0, Vec3::new(x, 1e-4, 1e-4)), inside, "{x}");
        }
    }

    #[test]
    fn only_voxels_away_from_the_surface_decide() {
        let surface = turned(&[(0.02, -0.03), (0.02, 0.03)], 64);
        let query = PointQuery::new(&[&surface], Vec3::zeros(), 2e-3);
        let occupancy = &query.surfaces[0].occupancy;
        assert_eq!(occupancy.contains(&Vec3::zeros()), Some(true));
        assert_eq!(
            occupancy.contains(&Vec3::new(0.0197, 0.0197, 0.0)),
            Some(false)
        );
        assert_eq!(occupancy.contains(&Vec3::new(0.02, 0.0, 0.0)), None);
    }
}
