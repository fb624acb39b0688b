//! Closed parts of the input that few rays of a bundle meet, measured by lines of their own.
//!
//! The lines are parallel to the axis that the part shows most of its wall to, one per triangle or piece of one where a line
//! enters. They are as dense as the part is small, so that neither its size nor its shape decides whether it is seen.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bvh::{Bvh, LineSide};
use super::components::Piece;
use super::inside::{PointQuery, facing};
use super::interfaces::halve;
use super::parts::ClosedParts;
use super::rays::hit_at;
use crate::Surface;

/// Lines through a part: at least half of them enter it at different places, at most twice as many.
const LINES: usize = 64;

/// Distance in m between two positions of a wall in single precision, at most.
const WALL: f64 = 1e-7;

/// A small closed part of a region's surface that encloses a volume of its own.
pub(super) struct SmallPart {
    /// Its region.
    pub(super) region: u8,
    /// Its number among the closed parts of the region.
    pub(super) part: u32,
    /// Volume in m³ less what later regions take.
    volume: f64,
    /// The axis of its lines.
    axis: usize,
    /// Stretches of lines inside.
    stretches: Vec<Stretch>,
}

/// A stretch of a line along an axis.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    from: Vec3,
    length: f64,
    /// Area across the line that it stands for, in m².
    area: f64,
}

impl Stretch {
    fn volume(&self) -> f64 {
        self.length * self.area
    }

    fn middle(&self, axis: usize) -> Vec3 {
        self.from + Vec3::ith(axis, self.length / 2.0)
    }
}

/// Measures those closed parts of a region for which `is_small` holds. Cavities are left out, and so are parts of which
/// nothing remains.
pub(super) fn small_parts(
    region: usize,
    surface: &Surface,
    parts: &ClosedParts,
    query: &PointQuery,
    is_small: impl Fn(u32) -> bool,
) -> Vec<SmallPart> {
    let mut triangles: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (triangle, &part) in parts.of_triangle.iter().enumerate() {
        if is_small(part) {
            triangles.entry(part).or_default().push(triangle as u32);
        }
    }
    let measure = |(part, triangles): (u32, Vec<u32>)| {
        let own = part_of(surface, &triangles);
        SmallPart::measure(&own, (region, part), query)
    };
    let triangles: Vec<_> = triangles.into_iter().collect();
    triangles.into_par_iter().filter_map(measure).collect()
}

/// Some triangles of a surface as one of its own.
fn part_of(surface: &Surface, triangles: &[u32]) -> Surface {
    let mut numbers = BTreeMap::new();
    let mut own = Surface::default();
    for &triangle in triangles {
        let corners = surface.triangles[triangle as usize].map(|v| {
            *numbers.entry(v).or_insert_with(|| {
                own.vertices.push(surface.vertices[v as usize]);
                own.vertices.len() as u32 - 1
            })
        });
        own.triangles.push(corners);
    }
    own
}

impl SmallPart {
    fn measure(own: &Surface, (region, part): (usize, u32), query: &PointQuery) -> Option<Self> {
        let volume = own.volume();
        if volume <= 0.0 {
            return None;
        }
        let axis = facing(own);
        let (mut whole, mut stretches) = (0.0, Vec::new());
        for stretch in stretches_of(own, axis) {
            whole += stretch.volume();
            let along = |r: usize| query.inside_along(r, stretch.from, axis);
            let mut inside = vec![[0.0, stretch.length]];
            let from = stretch.from[axis];
            let relative = |[a, b]: [f64; 2]| [a - from, b - from];
            // A part that lies within another one of its region is no component.
            let region_own = along(region).into_iter().map(relative);
            let region_own: Vec<[f64; 2]> = region_own.filter(|s| s[0] > -WALL).collect();
            inside = common(&inside, &region_own);
            for later in region + 1..query.regions() {
                if !inside.is_empty() {
                    let later: Vec<[f64; 2]> = along(later).into_iter().map(relative).collect();
                    inside = common(&inside, &gaps(&later));
                }
            }
            stretches.extend(inside.iter().map(|[a, b]| Stretch {
                from: stretch.from + Vec3::ith(axis, *a),
                length: b - a,
                area: stretch.area,
            }));
        }
        let kept: f64 = stretches.iter().map(Stretch::volume).sum();
        (kept > 0.0).then_some(Self {
            region: region as u8,
            part,
            volume: volume * (kept / whole).min(1.0),
            axis,
            stretches,
        })
    }

    /// The component that the part is. `query` is that of the model's region, if the model has one, and `component` finds the
    /// component of the model at a point.
    pub(super) fn piece(
        &self,
        query: Option<&PointQuery>,
        component: impl Fn(Vec3) -> Option<u32>,
    ) -> Piece {
        let axis = self.axis;
        let (mut all, mut kept, mut most) = (0.0, 0.0, 0.0);
        let mut within = None;
        let mut middle = Vec3::zeros();
        for stretch in &self.stretches {
            all += stretch.volume();
            middle += stretch.middle(axis) * stretch.volume();
            let along = query.map(|q| q.inside_along(0, stretch.from, axis));
            let from = stretch.from[axis];
            let span = [from, from + stretch.length];
            for [a, b] in common(&[span], &along.unwrap_or_default()) {
                let volume = (b - a) * stretch.area;
                kept += volume;
                if volume > most {
                    let mut at = stretch.from;
                    at[axis] = f64::midpoint(a, b);
                    (most, within) = (volume, component(at));
                }
            }
        }
        let off = |s: &Stretch| (s.middle(axis) - middle / all).norm_squared();
        let nearest = self
            .stretches
            .iter()
            .min_by(|s, t| off(s).total_cmp(&off(t)));
        Piece {
            region: self.region,
            volume: self.volume,
            kept: (kept / all).min(1.0),
            at: nearest.map_or(middle / all, |s| s.middle(axis)),
            within,
        }
    }
}

/// The common stretches of two sorted lists.
fn common(a: &[[f64; 2]], b: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let pairs = a
        .iter()
        .flat_map(|p| b.iter().map(move |q| [p[0].max(q[0]), p[1].min(q[1])]));
    pairs.filter(|[from, to]| from < to).collect()
}

/// The stretches between those of a sorted list, and before and after them.
fn gaps(stretches: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let ends = stretches.iter().map(|s| s[1]);
    let starts = stretches.iter().map(|s| s[0]);
    let from = std::iter::once(f64::NEG_INFINITY).chain(ends);
    let to = starts.chain(std::iter::once(f64::INFINITY));
    from.zip(to).map(|(from, to)| [from, to]).collect()
}

/// Stretches of lines along an axis inside a closed surface: a quadrature of its volume.
fn stretches_of(own: &Surface, axis: usize) -> Vec<Stretch> {
    let sides = [(axis + 1) % 3, (axis + 2) % 3];
    let area = |[a, b, c]: &[Vec3; 3]| (b - a).cross(&(c - a))[axis] / 2.0;
    let corners: Vec<[Vec3; 3]> = (0..own.triangles.len()).map(|t| own.corners(t)).collect();
    // A counter-clockwise triangle faces along the line, which leaves there.
    let entered: Vec<&[Vec3; 3]> = corners.iter().filter(|c| area(c) < 0.0).collect();
    let largest = entered.iter().map(|c| area(c)).sum::<f64>() / LINES as f64;
    let mut pieces = Vec::new();
    for triangle in entered {
        let mut stack = vec![*triangle];
        while let Some(piece) = stack.pop() {
            match halve(&piece, 0.0).filter(|_| area(&piece) < largest) {
                Some(halves) => stack.extend(halves),
                None => pieces.push(piece),
            }
        }
    }
    let origin = own.vertices.first().copied().unwrap_or_default();
    let flat = corners.iter().map(|c| Bvh::flat(&origin, c));
    let tree = Bvh::new(origin, flat.collect());
    let every = pieces.len().div_ceil(2 * LINES).max(1);
    let stretch = |piece: &[Vec3; 3]| {
        let from = (piece[0] + piece[1] + piece[2]) / 3.0;
        let mut length = f64::INFINITY;
        tree.for_line(&from, axis, LineSide::After, |at, corners| {
            let hit = hit_at(corners, axis, sides.map(|a| at[a]));
            if let Some(hit) = hit.filter(|h| h.turn < 0 && h.depth > at[axis]) {
                length = length.min(hit.depth - at[axis]);
            }
        });
        length.is_finite().then_some(Stretch {
            from,
            length,
            area: -area(piece),
        })
    };
    pieces.iter().step_by(every).filter_map(stretch).collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{ball, cuboid};
    use super::*;

    #[test]
    fn stretches_measure_coarse_and_fine_surfaces_along_each_axis() {
        let sides = Vec3::new(2.0, 0.3, 0.05);
        let bodies = [
            (cuboid(-sides / 2.0, sides / 2.0), sides, 1e-6),
            (ball(1.0), Vec3::repeat(4.0 / 3.0), 0.02),
        ];
        for (surface, mean, error) in bodies {
            for axis in 0..3 {
                let own = stretches_of(&surface, axis);
                assert!(
                    (LINES / 2..=2 * LINES).contains(&own.len()),
                    "{}",
                    own.len()
                );
                let area: f64 = own.iter().map(|s| s.area).sum();
                let found = own.iter().map(Stretch::volume).sum::<f64>() / area;
                assert!((found / mean[axis] - 1.0).abs() < error, "{found} {mean}");
            }
        }
    }

    #[test]
    fn gaps_and_common_stretches_complete_each_other() {
        let a = [[0.0, 1.0], [2.0, 5.0]];
        assert_eq!(common(&[[0.5, 4.0]], &a), [[0.5, 1.0], [2.0, 4.0]]);
        assert_eq!(common(&[[0.5, 6.0]], &gaps(&a)), [[1.0, 2.0], [5.0, 6.0]]);
        assert_eq!(common(&[[0.5, 6.0]], &gaps(&[])), [[0.5, 6.0]]);
    }
}
