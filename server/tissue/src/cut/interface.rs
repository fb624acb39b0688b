//! The surfaces around a node that it may not leave: interfaces and the outer surface as built, and walls of earlier cuts
//! as they stand.

use std::collections::BTreeSet;
use std::hash::BuildHasherDefault;

use super::ribbon::ROUNDING;
use super::sheet::nodes_of;
use crate::cell::{FACES, NO_CELL};
use crate::nearest::{Feature, nearest_feature};
use crate::number_map::NumberSet;
use crate::{FaceId, RegionId, Topology, Vec3};

/// Rounds of projections onto several surfaces (alternating projections), and rings of cells whose faces count.
const ROUNDS: usize = 4;
const RINGS: usize = 3;
/// Cells so near a node in a lattice.
const CELLS: usize = 160;

/// Faces of each surface near a node.
#[derive(Debug, Clone, Default)]
pub(crate) struct Interfaces(Vec<Vec<Quadrilateral>>);

/// A face as four triangles, by both diagonals, in a ball.
#[derive(Debug, Clone)]
struct Quadrilateral {
    corners: [Vec3; 4],
    middle: Vec3,
    radius: f64,
}

impl Quadrilateral {
    fn new(corners: [Vec3; 4]) -> Self {
        let middle = corners.iter().sum::<Vec3>() / 4.0;
        let radii = corners.iter().map(|x| (x - middle).norm());
        Self {
            corners,
            middle,
            radius: radii.fold(0.0, f64::max),
        }
    }

    fn triangles(&self) -> [[Vec3; 3]; 4] {
        let [a, b, c, d] = self.corners;
        [[a, b, c], [a, c, d], [a, b, d], [b, c, d]]
    }
}

/// Two regions, or one and the outside.
type Pair = (RegionId, Option<RegionId>);

fn pair_at(topology: &Topology, face: FaceId) -> Option<Pair> {
    let region = topology.region(face.cell());
    match topology.model.cells[face.cell() as usize].neighbours[face.face()] {
        NO_CELL => Some((region, None)),
        other => {
            let other = topology.region(other);
            (other != region).then_some((region.min(other), Some(region.max(other))))
        }
    }
}

impl Interfaces {
    /// Those that a node is on, as far as the cells around its neighbours.
    pub(crate) fn at(topology: &Topology, node: u32) -> Self {
        let model = &topology.model;
        let built = topology.origin(node);
        // Cells around the node as built: those around any of its copies, found through neighbours.
        let cells = cells_around(topology, node, |face| {
            model.cells[face.cell() as usize].neighbours[face.face()]
        });
        let faces = cells.into_iter().flat_map(faces_of);
        let faces: Vec<(Pair, [u32; 4])> = faces
            .filter_map(|face| {
                let corners =
                    FACES[face.face()].map(|i| model.cells[face.cell() as usize].corners[i]);
                Some((pair_at(topology, face)?, corners))
            })
            .collect();
        let own = faces.iter().filter(|(_, corners)| corners.contains(&built));
        let pairs: BTreeSet<Pair> = own.map(|face| face.0).collect();
        let of_pair = |pair| {
            let faces = faces.iter().filter(move |face| face.0 == pair);
            let corners = faces.map(|face| face.1.map(|n| model.nodes[n as usize]));
            corners.map(Quadrilateral::new).collect()
        };
        let mut surfaces: Vec<_> = pairs.into_iter().map(of_pair).collect();
        if topology.is_at_wall(node) {
            let cells = cells_around(topology, node, |face| topology.across(face));
            let faces = cells.into_iter().flat_map(faces_of);
            let opened = faces.filter(|&f| topology.is_opened(f));
            let corners = opened.map(|f| nodes_of(topology, f).map(|n| topology.rest(n)));
            surfaces.push(corners.map(Quadrilateral::new).collect());
        }
        Self(surfaces)
    }

    /// The place within a distance of them nearest to `p`.
    pub(crate) fn clamp(&self, p: Vec3, distance: f64) -> Vec3 {
        let on = self.project(p);
        let off = p - on;
        let size = off.norm();
        if size > distance {
            on + off * (distance / size)
        } else {
            p
        }
    }

    /// A place on them near `p`: projected onto one after the other.
    pub(crate) fn project(&self, mut p: Vec3) -> Vec3 {
        let rounds = if self.0.len() > 1 { ROUNDS } else { 1 };
        for faces in self.0.iter().cycle().take(rounds * self.0.len()) {
            p = nearest(faces, &p);
        }
        p
    }

    /// Distance of `p` from the farthest of them.
    pub(crate) fn distance(&self, p: &Vec3) -> f64 {
        let distances = self.0.iter().map(|faces| (nearest(faces, p) - p).norm());
        distances.fold(0.0, f64::max)
    }
}

/// The cells around a node and as far as [`RINGS`] steps to the cells behind faces, ascending.
fn cells_around(topology: &Topology, node: u32, behind: impl Fn(FaceId) -> u32) -> Vec<u32> {
    let own = topology.node_cells[node as usize].into_iter();
    let mut cells = Vec::with_capacity(CELLS);
    cells.extend(own.filter(|&c| c != NO_CELL));
    let mut known = NumberSet::with_capacity_and_hasher(CELLS, BuildHasherDefault::default());
    known.extend(cells.iter().copied());
    let mut from = 0;
    for _ in 0..RINGS {
        let until = cells.len();
        for cell in from..until {
            let more = faces_of(cells[cell]).map(&behind);
            cells.extend(more.filter(|&c| c != NO_CELL && known.insert(c)));
        }
        from = until;
    }
    cells.sort_unstable();
    cells
}

fn faces_of(cell: u32) -> impl Iterator<Item = FaceId> {
    (0..6).map(move |face| FaceId::new(cell, face))
}

/// The point of faces nearest to `p`, by the first triangle that has it.
fn nearest(faces: &[Quadrilateral], p: &Vec3) -> Vec3 {
    // A corner is at this distance, and no point of a face is nearer than its ball.
    let corners = faces
        .iter()
        .map(|face| (face.corners[0] - p).norm_squared());
    let bound = corners.fold(f64::INFINITY, f64::min).sqrt();
    let is_near = |face: &&Quadrilateral| {
        let reach = (bound + face.radius) * (1.0 + ROUNDING);
        (face.middle - p).norm_squared() <= reach * reach
    };
    let mut best = (f64::INFINITY, *p);
    let near = faces.iter().filter(is_near);
    for corners in near.flat_map(Quadrilateral::triangles) {
        // No point of it is nearer than its first corner by more than its longest edge there; (a + b)² <= 2 a² + 2 b².
        let edges = [1, 2].map(|i| (corners[i] - corners[0]).norm_squared());
        if (corners[0] - p).norm_squared() > 2.0 * (best.0 + edges[0].max(edges[1])) {
            continue;
        }
        let q = match nearest_feature(p, &corners) {
            Feature::Corner(i) => corners[i],
            Feature::Edge(i, j, part) => corners[i] + (corners[j] - corners[i]) * part,
            Feature::Face(weights) => {
                let sum: f64 = weights.iter().sum();
                let parts = corners.iter().zip(weights);
                parts.map(|(x, w)| x * (w / sum)).sum()
            }
        };
        let distance = (q - p).norm_squared();
        if distance < best.0 {
            best = (distance, q);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn place() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-3.0..3.0f64).prop_map(Vec3::from)
    }

    fn face() -> impl Strategy<Value = Quadrilateral> {
        let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let corner = prop::array::uniform3(-0.4..0.4f64).prop_map(Vec3::from);
        (place(), prop::array::uniform4(corner)).prop_map(move |(at, off)| {
            let corner = |i: usize| at + off[i] + Vec3::new(corners[i][0], corners[i][1], 0.0);
            Quadrilateral::new(std::array::from_fn(corner))
        })
    }

    proptest! {
        #[test]
        fn nearest_point_is_that_of_every_single_face(
            faces in prop::collection::vec(face(), 1..30),
            p in place(),
        ) {
            let distance = |q: Vec3| (q - p).norm_squared();
            let alone = faces.chunks(1).map(|face| nearest(face, &p));
            let first = alone.fold(None, |best: Option<Vec3>, q| match best {
                Some(known) if distance(known) <= distance(q) => best,
                _ => Some(q),
            });
            prop_assert_eq!(Some(nearest(&faces, &p)), first);
        }
    }
}
