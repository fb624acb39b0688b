//! Gravity: the body force of the equilibrium.
//!
//! A node carries an eighth of the weight of each of its cells, as built: cuts change no weight. A component without
//! pinned nodes has no equilibrium under gravity, so its weight is zero.

use super::quad::{Quad, ZERO};
use crate::{Model, Topology};

/// Weight of each node in N, pinned ones included; empty without gravity.
pub(super) fn weights(topology: &Topology) -> Vec<Quad> {
    let gravity = topology.model().gravity;
    if gravity == [0.0; 3] {
        return Vec::new();
    }
    let hangs = hanging_nodes(topology);
    let of = |node: u32| {
        if hangs[node as usize] {
            weight_of(topology, node)
        } else {
            ZERO
        }
    };
    (0..topology.node_count() as u32).map(of).collect()
}

/// Whether each node is connected through cells to a pinned node.
fn hanging_nodes(topology: &Topology) -> Vec<bool> {
    let nodes = 0..topology.node_count() as u32;
    let pinned: Vec<bool> = nodes.map(|n| topology.is_pinned(n)).collect();
    hanging(
        (0..topology.cell_count() as u32).map(|c| topology.corners(c)),
        &pinned,
    )
}

/// Weight of a node in N, if its component hangs.
pub(super) fn weight_of(topology: &Topology, node: u32) -> Quad {
    let [x, y, z] = topology.model().gravity;
    [x, y, z, 0.0].map(|g| (topology.mass(node) * g) as f32)
}

impl Model {
    /// Number of nodes without weight in spite of gravity, because their component has no pinned node.
    pub fn adrift_nodes(&self) -> usize {
        if self.gravity == [0.0; 3] {
            return 0;
        }
        let mut pinned = vec![false; self.nodes.len()];
        for cell in &self.cells {
            if self.regions[cell.region.index()].pinned {
                for &node in &cell.corners {
                    pinned[node as usize] = true;
                }
            }
        }
        let hangs = hanging(self.cells.iter().map(|c| c.corners), &pinned);
        hangs.iter().filter(|hangs| !**hangs).count()
    }
}

/// Whether each node is connected through cells to a pinned node.
fn hanging(cells: impl Iterator<Item = [u32; 8]>, pinned: &[bool]) -> Vec<bool> {
    // A union-find forest over the nodes.
    let mut parents: Vec<u32> = (0..pinned.len() as u32).collect();
    for corners in cells {
        let first = root(&mut parents, corners[0]);
        for &other in &corners[1..] {
            let other = root(&mut parents, other);
            parents[other as usize] = first;
        }
    }
    let nodes = 0..pinned.len() as u32;
    let roots: Vec<u32> = nodes.map(|n| root(&mut parents, n)).collect();
    let mut holds = vec![false; pinned.len()];
    for (&root, _) in roots.iter().zip(pinned).filter(|(_, pinned)| **pinned) {
        holds[root as usize] = true;
    }
    roots.into_iter().map(|root| holds[root as usize]).collect()
}

/// The root of a node, with path compression.
fn root(parents: &mut [u32], mut node: u32) -> u32 {
    while parents[node as usize] != node {
        let above = parents[parents[node as usize] as usize];
        parents[node as usize] = above;
        node = above;
    }
    node
}
