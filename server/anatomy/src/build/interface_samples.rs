//! Samples of the input's interfaces: thickness of the layers beside them, and distance to the model's own
//! interface.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bvh::Bvh;
use super::faces::Face;
use super::interfaces::{Interfaces, halve, sides_of};
use super::region_surfaces::ModelSurfaces;

/// Longest side, in spacings, of a piece that one sample stands for.
const SIDE_MAX: f64 = 1.0;
/// Least area, in Δd², that one sample stands for: a finer input is not sampled more finely.
const AREA_MIN: f64 = 0.4;
/// Triangles sampled by one task.
const CHUNK: usize = 1024;
/// Offset from a surface at which a search ray starts, in spacings.
const LOOK: f64 = 0.02;
/// Search radius for the model's interface around the input's, in spacings. A reported distance of this size is
/// a lower bound.
const DISTANCE_REACH: f64 = 3.0;

/// A point of an input interface.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Its position in m.
    pub(super) at: Vec3,
    /// Area that it stands for, in m².
    pub(super) area: f64,
    /// The region behind the interface.
    pub(super) behind: u16,
    /// The region before it, or [`OUTSIDE`](super::faces::OUTSIDE).
    pub(super) before: u16,
    /// The layer beside it that is thinner than the spacing, if one is.
    pub(super) thin: Option<Thin>,
    /// Distance in m from the model's interface; [`DISTANCE_REACH`] spacings where there is none so near.
    pub(super) distance: f64,
    /// Distance in m from the surface in the model of the region behind, and of the region before it; infinite where
    /// the model has none.
    pub(super) from_region: [f32; 2],
}

/// A layer that is thinner than the spacing.
#[derive(Debug, Clone, Copy)]
pub(super) struct Thin {
    /// Its region, or [`OUTSIDE`](super::faces::OUTSIDE) for a gap.
    pub(super) region: u16,
    /// The region beyond it.
    pub(super) beyond: u16,
    /// Thickness in m along the normal.
    pub(super) thickness: f64,
}

/// Samples all interfaces of the input.
pub(super) fn samples(
    interfaces: &Interfaces,
    faces: &[Face],
    positions: &[Vec3],
    middle: Vec3,
) -> Vec<Sample> {
    let model = ModelSurfaces::new(interfaces, faces, positions, middle);
    let by_region = model.by_region();
    let mut samples = Vec::new();
    for interface in interfaces.all() {
        let bvh = interfaces.bvh(interface);
        if bvh.is_empty() {
            continue;
        }
        let chunks = bvh.len().div_ceil(CHUNK);
        let found: Vec<Vec<Sample>> = (0..chunks)
            .into_par_iter()
            .map(|chunk| {
                let range = chunk * CHUNK..((chunk + 1) * CHUNK).min(bvh.len());
                let mut points = Vec::new();
                spread(bvh, range, interfaces.spacing, &mut points);
                points
                    .into_iter()
                    .map(|p| {
                        let mut sample = measure(&p, interfaces, model.of(interface));
                        let regions = [sample.behind, sample.before];
                        sample.from_region =
                            regions.map(|r| by_region.distance(&sample.at, r, interface) as f32);
                        sample
                    })
                    .collect()
            })
            .collect();
        for mut more in found {
            samples.append(&mut more);
        }
    }
    samples
}

/// A point to probe.
struct Point {
    at: Vec3,
    /// Unit normal.
    normal: Vec3,
    area: f64,
    /// The regions behind and before it.
    sides: [u16; 2],
}

fn spread(bvh: &Bvh, range: std::ops::Range<usize>, spacing: f64, points: &mut Vec<Point>) {
    let mut carried = 0.0;
    let mut last = None;
    for triangle in range {
        let corners = bvh.triangle(triangle);
        let sides = sides_of(bvh.tag(triangle));
        let vector = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])) / 2.0;
        let Some(normal) = vector.try_normalize(0.0) else {
            continue;
        };
        let mut stack = vec![corners];
        while let Some(piece) = stack.pop() {
            if let Some(halves) = halve(&piece, SIDE_MAX * spacing) {
                stack.extend(halves);
                continue;
            }
            let at = (piece[0] + piece[1] + piece[2]) / 3.0;
            carried += (piece[1] - piece[0]).cross(&(piece[2] - piece[0])).norm() / 2.0;
            if carried >= AREA_MIN * spacing * spacing {
                points.push(Point {
                    at,
                    normal,
                    area: carried,
                    sides,
                });
                carried = 0.0;
            }
            last = Some((at, normal, sides));
        }
    }
    if let Some((at, normal, sides)) = last
        && carried > 0.0
    {
        points.push(Point {
            at,
            normal,
            area: carried,
            sides,
        });
    }
}

/// The first crossing along a direction.
struct Wall {
    /// Its distance in m.
    depth: f64,
    /// The region beyond it.
    beyond: u16,
}

fn first_wall(interfaces: &Interfaces, from: &Vec3, way: &Vec3) -> Option<Wall> {
    let met = interfaces.all().filter_map(|i| {
        let bvh = interfaces.bvh(i);
        let (depth, triangle) = bvh.first_along(from, way)?;
        Some((depth, triangle, bvh))
    });
    let (depth, triangle, bvh) = met.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let [a, b, c] = bvh.triangle(triangle);
    let leaves = (b - a).cross(&(c - a)).dot(way) > 0.0;
    let beyond = sides_of(bvh.tag(triangle))[usize::from(leaves)];
    Some(Wall { depth, beyond })
}

fn measure(
    &Point {
        at,
        normal,
        area,
        sides,
    }: &Point,
    interfaces: &Interfaces,
    own: &Bvh,
) -> Sample {
    let spacing = interfaces.spacing;
    let look = normal * (LOOK * spacing);
    let [behind, before] = sides;
    let mut thin: Option<Thin> = None;
    for (side, of) in [(1.0, before), (-1.0, behind)] {
        let from = at + look * side;
        let way = normal * (side * (1.0 - LOOK) * spacing);
        let Some(wall) = first_wall(interfaces, &from, &way) else {
            continue;
        };
        let thickness = wall.depth + LOOK * spacing;
        if thin.is_none_or(|t| thickness < t.thickness) {
            thin = Some(Thin {
                region: of,
                beyond: wall.beyond,
                thickness,
            });
        }
    }
    let reach = DISTANCE_REACH * spacing;
    let distance = own.nearest(&at, reach).map_or(reach, |p| (p - at).norm());
    Sample {
        at,
        area,
        behind,
        before,
        thin,
        distance,
        from_region: [f32::INFINITY; 2],
    }
}
