//! The interfaces and outer surfaces as built around a node, which it may not leave.

use std::collections::BTreeMap;

use crate::cell::{FACES, NO_CELL};
use crate::nearest::{Feature, nearest_feature};
use crate::{FaceId, RegionId, Topology, Vec3};

/// Triangles of each interface near a node, by both diagonals of every face.
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
        let own: Vec<u32> = topology.node_cells[node as usize]
            .into_iter()
            .filter(|&c| c != NO_CELL)
            .collect();
        let mut cells = own;
        for _ in 0..3 {
            let more: Vec<u32> = cells
                .iter()
                .flat_map(|&c| model.cells[c as usize].neighbours)
                .filter(|&c| c != NO_CELL)
                .collect();
            cells.extend(more);
            cells.sort_unstable();
            cells.dedup();
        }
        let faces = cells
            .iter()
            .flat_map(|&c| (0..6).map(move |f| FaceId::new(c, f)));
        let mut found: BTreeMap<Pair, (bool, Vec<[Vec3; 3]>)> = BTreeMap::new();
        for face in faces {
            if let Some(pair) = pair_at(topology, face) {
                let corners =
                    FACES[face.face()].map(|i| model.cells[face.cell() as usize].corners[i]);
                let entry = found.entry(pair).or_default();
                entry.0 |= corners.contains(&built);
                let [a, b, c, d] = corners.map(|n| model.nodes[n as usize]);
                entry.1.extend([[a, b, c], [a, c, d], [a, b, d], [b, c, d]]);
            }
        }
        Self(found.into_values().filter(|e| e.0).map(|e| e.1).collect())
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

    /// The place on them nearest to `p`: projected onto one after the other.
    pub(crate) fn project(&self, mut p: Vec3) -> Vec3 {
        for triangles in &self.0 {
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

fn nearest(triangles: &[[Vec3; 3]], p: &Vec3) -> Vec3 {
    let mut best = (f64::INFINITY, *p);
    for corners in triangles {
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
