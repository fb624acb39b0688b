//! Closed parts of the input that few rays of a bundle meet, measured by lines of their own.
//!
//! The lines are parallel to the axis that the part shows most of its wall to, one per triangle or piece of one where a line
//! enters. They are as dense as the part is small, so that neither its size nor its shape decides whether it is seen.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::components::{Component, Piece};
use super::inside::{PointQuery, facing};
use super::interfaces::halve;
use super::parts::ClosedParts;
use super::rays::hit_at;
use crate::Surface;

/// Lines through a part: at least half of them enter it at different places, at most twice as many.
const LINES: usize = 64;
/// Samples of a line; one of them in its middle.
const SAMPLES: usize = 5;
/// A part is whole when later regions take less than this of it: rounding.
const WHOLE: f64 = 1e-9;
/// Distance of the probes before and behind the wall of a part, in spacings.
const LOOK: f64 = 1e-3;

/// A small closed part of a region's surface that encloses a volume of its own.
pub(super) struct SmallPart {
    /// Its region.
    pub(super) region: u8,
    /// Its number among the closed parts of the region.
    pub(super) part: u32,
    /// Whether no later region takes any of it.
    pub(super) is_whole: bool,
    /// Volume in m³ less what later regions take.
    volume: f64,
    /// The sample next to the middle of all.
    at: Vec3,
    /// Points of the region inside, each with the volume that it stands for, in any unit.
    samples: Vec<(Vec3, f64)>,
}

/// Measures those closed parts of a region for which `is_small` holds. Cavities are left out, and so are parts of which
/// nothing remains, or whose wall lies within their own region.
pub(super) fn small_parts(
    region: usize,
    surface: &Surface,
    parts: &ClosedParts,
    (query, spacing): (&PointQuery, f64),
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
        SmallPart::measure(&own, (region, part), query, spacing)
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

/// A line's stretch inside a part.
struct Stretch {
    from: Vec3,
    to: Vec3,
    /// Area across the line that it stands for, in m².
    area: f64,
}

impl SmallPart {
    fn measure(
        own: &Surface,
        (region, part): (usize, u32),
        query: &PointQuery,
        spacing: f64,
    ) -> Option<Self> {
        let volume = own.volume();
        if volume <= 0.0 {
            return None;
        }
        let axis = facing(own);
        let along = Vec3::ith(axis, 1.0);
        let look = along * (LOOK * spacing);
        let mut whole = 0.0;
        let mut samples = Vec::new();
        for stretch in stretches(own, axis) {
            let beyond = [stretch.from - look, stretch.to + look];
            if beyond.iter().any(|p| query.contains(region, *p)) {
                return None;
            }
            let share = (stretch.to - stretch.from).dot(&along) * stretch.area;
            whole += share;
            let points = (0..SAMPLES).map(|sample| {
                let part = (sample as f64 + 0.5) / SAMPLES as f64;
                stretch.from.lerp(&stretch.to, part)
            });
            let kept = points.filter(|p| query.region_at(*p) == Some(region));
            samples.extend(kept.map(|p| (p, share / SAMPLES as f64)));
        }
        let kept: f64 = samples.iter().map(|s| s.1).sum();
        let middle = samples.iter().map(|s| s.0 * s.1).sum::<Vec3>() / kept;
        let points = samples.iter().map(|s| s.0);
        let off = |p: &Vec3| (p - middle).norm_squared();
        Some(Self {
            region: region as u8,
            part,
            is_whole: kept > whole * (1.0 - WHOLE),
            volume: volume * kept / whole,
            at: points.min_by(|p, q| off(p).total_cmp(&off(q)))?,
            samples,
        })
    }

    /// The component that the part is. `holds` tells whether the model's region contains a point, `piece` the component
    /// of the model there.
    pub(super) fn component(
        &self,
        holds: impl Fn(Vec3) -> bool,
        piece: impl Fn(Vec3) -> Option<u32>,
    ) -> Component {
        let (mut all, mut kept, mut within) = (0.0, 0.0, None);
        for &(point, share) in &self.samples {
            all += share;
            if holds(point) {
                kept += share;
                within = within.or_else(|| piece(point));
            }
        }
        Component::from(Piece {
            region: self.region,
            volume: self.volume,
            kept: kept / all,
            at: self.at,
            within,
        })
    }
}

/// Stretches of lines along an axis inside a closed surface: a quadrature of its volume.
fn stretches(own: &Surface, axis: usize) -> Vec<Stretch> {
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
    let every = pieces.len().div_ceil(2 * LINES).max(1);
    let stretch = |piece: &[Vec3; 3]| {
        let from = (piece[0] + piece[1] + piece[2]) / 3.0;
        let at = sides.map(|a| from[a]);
        let hits = corners.iter().filter_map(|c| hit_at(c, axis, at));
        let leaves = hits.filter(|h| h.turn < 0 && h.depth > from[axis]);
        let depth = leaves.map(|h| h.depth).min_by(f64::total_cmp)?;
        let mut to = from;
        to[axis] = depth;
        Some(Stretch {
            from,
            to,
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
            (cuboid(-sides / 2.0, sides / 2.0), sides, 1e-9),
            (ball(1.0), Vec3::repeat(4.0 / 3.0), 0.02),
        ];
        for (surface, mean, error) in bodies {
            for axis in 0..3 {
                let own = stretches(&surface, axis);
                assert!(
                    (LINES / 2..=2 * LINES).contains(&own.len()),
                    "{}",
                    own.len()
                );
                let area: f64 = own.iter().map(|s| s.area).sum();
                let volume: f64 = own.iter().map(|s| (s.to - s.from).norm() * s.area).sum();
                let found = volume / area;
                assert!((found / mean[axis] - 1.0).abs() < error, "{found} {mean}");
            }
        }
    }
}
