//! The surfaces around a node that it may not leave: interfaces and the outer surface as built, and walls of earlier cuts
//! as they stand.

use std::collections::BTreeMap;

use super::sheet::nodes_of;
use crate::cell::{FACES, NO_CELL};
use crate::nearest::{Feature, nearest_feature};
use crate::{FaceId, RegionId, Topology, Vec3};

/// Rounds of projections onto several surfaces (alternating projections), and rings of cells whose faces count.
const ROUNDS: usize = 4;
const RINGS: usize = 3;

/// Triangles of each surface near a node, by both diagonals of every face.
#[derive(Debug, Clone, Default)]
pub(crate) struct Interfaces(Vec<Vec<[Vec3; 3]>>);

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
        let faces = faces_around(topology, node, |face| {
            model.cells[face.cell() as usize].neighbours[face.face()]
        });
        let mut found: BTreeMap<Pair, (bool, Vec<[Vec3; 3]>)> = BTreeMap::new();
        for face in faces {
            if let Some(pair) = pair_at(topology, face) {
                let corners =
                    FACES[face.face()].map(|i| model.cells[face.cell() as usize].corners[i]);
                let entry = found.entry(pair).or_default();
                entry.0 |= corners.contains(&built);
                entry
                    .1
                    .extend(triangles(corners.map(|n| model.nodes[n as usize])));
            }
        }
        let mut surfaces: Vec<_> = found.into_values().filter(|e| e.0).map(|e| e.1).collect();
        if topology.is_at_wall(node) {
            let faces = faces_around(topology, node, |face| topology.across(face)).into_iter();
            let opened = faces.filter(|&f| topology.is_opened(f));
            let corners = opened.map(|f| nodes_of(topology, f).map(|n| topology.rest(n)));
            surfaces.push(corners.flat_map(triangles).collect());
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
        for triangles in self.0.iter().cycle().take(rounds * self.0.len()) {
            p = nearest(triangles, &p);
        }
        p
    }

    /// Distance of `p` from the farthest of them.
    pub(crate) fn distance(&self, p: &Vec3) -> f64 {
        let distances = self.0.iter().map(|t| (nearest(t, p) - p).norm());
        distances.fold(0.0, f64::max)
    }
}

/// All faces of the cells around a node as far as [`RINGS`] steps to the cells behind faces.
fn faces_around(topology: &Topology, node: u32, behind: impl Fn(FaceId) -> u32) -> Vec<FaceId> {
    let own = topology.node_cells[node as usize].into_iter();
    let mut cells: Vec<u32> = own.filter(|&c| c != NO_CELL).collect();
    let faces = |cells: &[u32]| -> Vec<FaceId> {
        let faces = |&c: &u32| (0..6).map(move |f| FaceId::new(c, f));
        cells.iter().flat_map(faces).collect()
    };
    for _ in 0..RINGS {
        let more = faces(&cells).into_iter().map(&behind);
        cells.extend(more.filter(|&c| c != NO_CELL));
        cells.sort_unstable();
        cells.dedup();
    }
    faces(&cells)
}

fn triangles([a, b, c, d]: [Vec3; 4]) -> [[Vec3; 3]; 4] {
    [[a, b, c], [a, c, d], [a, b, d], [b, c, d]]
}

fn nearest(triangles: &[[Vec3; 3]], p: &Vec3) -> Vec3 {
    let mut best = (f64::INFINITY, *p);
    for corners in triangles {
        // No point of it is nearer than its first corner by more than its longest edge there; (a + b)² <= 2 a² + 2 b².
        let edges = [1, 2].map(|i| (corners[i] - corners[0]).norm_squared());
        if (corners[0] - p).norm_squared() > 2.0 * (best.0 + edges[0].max(edges[1])) {
            continue;
        }
        let q = match nearest_feature(p, corners) {
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
