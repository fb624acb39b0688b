//! Rims of an interface: edges where it turns sharply, as where a flat end meets the side, and the
//! corners where such edges meet.
//!
//! Projecting nodes onto the nearest point of a surface rounds its rims off, and the cells there get bad
//! corners. So nodes on a rim of the lattice are put onto the rim itself.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use rayon::prelude::*;

use crate::Surface;

/// The cosine of the angle between the normals of two faces beyond which their edge is a rim
/// (45°: marching-cubes staircases stay below, machined edges and caps lie above).
const RIM_COSINE: f64 = 0.707;

/// Two edges that leave a point at less than 120° make a corner of it.
const CORNER_COSINE: f64 = -0.5;

/// Farthest, in spacings, that a node at a corner of the lattice is from the corner it is put onto.
pub(super) const CORNER_REACH: f64 = 0.9;
/// Farthest, in spacings, that any node is put onto a corner. A corner that points along an axis ends up to a
/// spacing beyond the last layer of nodes.
const BLUNT_REACH: f64 = 1.25;

/// One straight piece of a rim.
#[derive(Debug, Clone, Copy)]
pub(super) struct Segment {
    ends: [Vec3; 2],
    /// Outward normals of the two faces that meet there.
    pub(super) normals: [Vec3; 2],
}

impl Segment {
    /// Sum of the normals.
    pub(super) fn facing(&self) -> Vec3 {
        self.normals[0] + self.normals[1]
    }

    fn nearest(&self, point: &Vec3) -> Vec3 {
        let along = self.ends[1] - self.ends[0];
        let length = along.norm_squared();
        let t = if length > 0.0 {
            (point - self.ends[0]).dot(&along) / length
        } else {
            0.0
        };
        self.ends[0] + along * t.clamp(0.0, 1.0)
    }
}

/// All rims, sorted into cubes for look-up.
#[derive(Debug, Default)]
pub(super) struct Rims {
    segments: Vec<Segment>,
    /// Where three edges meet, or two at an angle: position, and the sum of the normals around.
    corners: Vec<(Vec3, Vec3)>,
    side: f64,
    cubes: BTreeMap<[i64; 3], Vec<u32>>,
    corner_cubes: BTreeMap<[i64; 3], Vec<u32>>,
}

impl Rims {
    /// Takes one more segment.
    pub(super) fn add(&mut self, segment: Segment) {
        self.segments.push(segment);
    }

    /// Sorts the segments into cubes of side `reach`.
    pub(super) fn index(&mut self, reach: f64) {
        self.side = reach;
        self.find_corners();
        for (index, (corner, _)) in self.corners.iter().enumerate() {
            let at = cube(corner, BLUNT_REACH * reach);
            let list = self.corner_cubes.entry(at).or_default();
            list.push(index as u32);
        }
        for (index, segment) in self.segments.iter().enumerate() {
            let steps = ((segment.ends[1] - segment.ends[0]).norm() / reach * 2.0).ceil() as usize;
            for s in 0..=steps {
                let t = if steps == 0 {
                    0.0
                } else {
                    s as f64 / steps as f64
                };
                let at = segment.ends[0].lerp(&segment.ends[1], t);
                let list = self.cubes.entry(cube(&at, reach)).or_default();
                if list.last() != Some(&(index as u32)) {
                    list.push(index as u32);
                }
            }
        }
    }

    /// Finds the points where two segments meet at an angle.
    fn find_corners(&mut self) {
        let bits = |p: &Vec3| [p.x.to_bits(), p.y.to_bits(), p.z.to_bits()];
        let mut ways: BTreeMap<[u64; 3], (Vec<Vec3>, Vec3)> = BTreeMap::new();
        for segment in &self.segments {
            let [a, b] = &segment.ends;
            if let Some(way) = (b - a).try_normalize(0.0) {
                for (end, way) in [(a, way), (b, -way)] {
                    let entry = ways.entry(bits(end)).or_default();
                    entry.0.push(way);
                    entry.1 += segment.facing();
                }
            }
        }
        let turns = |(ways, _): &(Vec<Vec3>, Vec3)| {
            let pairs = ways.iter().enumerate();
            pairs
                .flat_map(|(i, a)| ways[i + 1..].iter().map(move |b| a.dot(b)))
                .any(|cosine| cosine > CORNER_COSINE)
        };
        let sharp = ways.iter().filter(|(_, ways)| turns(ways));
        self.corners = sharp
            .map(|(at, (_, facing))| (Vec3::from(at.map(f64::from_bits)), *facing))
            .collect();
    }

    /// Number and distance of the corner nearest to `point`, within [`BLUNT_REACH`] cube sides, whose sum of
    /// normals passes `accept`.
    pub(super) fn nearest_corner(
        &self,
        point: &Vec3,
        accept: impl Fn(&Vec3) -> bool,
    ) -> Option<(u32, f64)> {
        if self.corners.is_empty() {
            return None;
        }
        let distance = |index: u32| (self.corners[index as usize].0 - point).norm();
        cubes_around(point, BLUNT_REACH * self.side)
            .filter_map(|at| self.corner_cubes.get(&at))
            .flatten()
            .filter(|index| accept(&self.corners[**index as usize].1))
            .map(|&index| (index, distance(index)))
            .filter(|(_, distance)| *distance <= BLUNT_REACH * self.side)
            .min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)))
    }

    /// The corner nearest to `point` whose sum of normals passes `accept`.
    pub(super) fn corner_near(&self, point: &Vec3, accept: impl Fn(&Vec3) -> bool) -> Option<Vec3> {
        self.nearest_corner(point, accept)
            .map(|(index, _)| self.corners[index as usize].0)
    }

    /// The nearest rim point within one cube side of `point` whose segment passes `accept`.
    pub(super) fn nearest(&self, point: &Vec3, accept: impl Fn(&Segment) -> bool) -> Option<Vec3> {
        if self.segments.is_empty() {
            return None;
        }
        let mut best: Option<(f64, Vec3)> = None;
        for at in cubes_around(point, self.side) {
            let reach = best.map_or(self.side, |b| b.0);
            // A segment may be listed in the next cube only, a quarter of a side away.
            if distance_to_cube(point, at, self.side) > reach + self.side / 4.0 {
                continue;
            }
            for &index in self.cubes.get(&at).into_iter().flatten() {
                let segment = &self.segments[index as usize];
                let nearest = segment.nearest(point);
                let distance = (nearest - point).norm();
                if distance <= self.side && best.is_none_or(|b| distance < b.0) && accept(segment) {
                    best = Some((distance, nearest));
                }
            }
        }
        best.map(|b| b.1)
    }
}

/// The sharp edges between two triangles of a mask, for each mask, with the number of the mask. `turned`
/// triangles face inwards.
pub(super) fn sharp_edges(
    surface: &Surface,
    masks: [&[bool]; 2],
    turned: &[bool],
) -> Vec<(usize, Segment)> {
    let normal = |t: u32| {
        let [a, b, c] = surface.corners(t as usize);
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0)?;
        Some(if turned[t as usize] { -normal } else { normal })
    };
    // Sorted instead of in a map: ten million triangles have thirty million uses of edges.
    let mut uses: Vec<[u32; 3]> = Vec::with_capacity(3 * surface.triangles.len());
    for (t, [a, b, c]) in surface.triangles.iter().enumerate() {
        for [a, b] in [[*a, *b], [*b, *c], [*c, *a]] {
            uses.push([a.min(b), a.max(b), t as u32]);
        }
    }
    uses.par_sort_unstable();
    uses.par_chunk_by(|u, v| u[..2] == v[..2])
        .flat_map_iter(|of_edge| {
            masks.iter().enumerate().filter_map(move |(which, mask)| {
                let mut triangles = of_edge.iter().map(|u| u[2]).filter(|t| mask[*t as usize]);
                let (first, second) = (triangles.next()?, triangles.next()?);
                if triangles.next().is_some() {
                    return None;
                }
                let (n, m) = (normal(first)?, normal(second)?);
                let ends = [of_edge[0][0], of_edge[0][1]].map(|v| surface.vertices[v as usize]);
                let normals = [n, m];
                (n.dot(&m) < RIM_COSINE).then_some((which, Segment { ends, normals }))
            })
        })
        .collect()
}

/// The cube that contains a point and the 26 around it; its own comes first, as it holds the nearest
/// candidates.
fn cubes_around(point: &Vec3, side: f64) -> impl Iterator<Item = [i64; 3]> + use<> {
    let [x, y, z] = cube(point, side);
    let step = |n: i64| (n + 1) % 3 - 1;
    (0..27).map(move |n| [x + step(n), y + step(n / 3), z + step(n / 9)])
}

fn distance_to_cube(point: &Vec3, cube: [i64; 3], side: f64) -> f64 {
    let low = Vec3::from(cube.map(|i| i as f64)) * side;
    let apart = (low - point).sup(&(point - low).add_scalar(-side));
    apart.sup(&Vec3::zeros()).norm()
}

fn cube(point: &Vec3, side: f64) -> [i64; 3] {
    [point.x, point.y, point.z].map(|x| (x / side).floor() as i64)
}
