//! How a deformed shape follows a cut without a jump.
//!
//! A cut moves rest positions within tissue that may be deformed. The deformation itself stays as it
//! is: a node whose rest position moved takes the displacement that the old shape had at its new
//! rest position, by trilinear interpolation in the old cell around it; a doubled node takes that of
//! the node it came from.

use super::CutOutcome;
use super::bounded_moves::Moves;
use super::trilinear::{invert, weights};
use crate::cell::NO_CELL;
use crate::{Shape, Topology, Vec3};

/// How far outside a cell a displacement may be extrapolated, in cells.
const OUTSIDE_MAX: f64 = 0.25;

/// A node whose rest position moved, and where its displacement comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moved {
    /// The node.
    pub node: u32,
    /// Nodes of the topology before the cut, and the share of each; the shares sum to 1.
    pub weights: [(u32, f64); 8],
}

/// Where the displacement of each moved node comes from; sorted by node.
pub(crate) fn moved(moves: &Moves<'_>) -> Vec<Moved> {
    let mut nodes: Vec<u32> = moves.old.keys().copied().collect();
    nodes.sort_unstable();
    nodes.into_iter().map(|node| source(moves, node)).collect()
}

fn source(moves: &Moves<'_>, node: u32) -> Moved {
    let to = moves.rest(node);
    let way = to - moves.old_rest(node);
    // The cell it most likely went into comes first: the node is a low corner of that along the axes
    // it moved up.
    let likely: usize = (0..3).map(|a| usize::from(way[a] < 0.0) << a).sum();
    let mut best: Option<(f64, u32, Vec3)> = None;
    for slot in 0..8 {
        let cell = moves.topology.node_cells[node as usize][slot ^ likely];
        if cell == NO_CELL {
            continue;
        }
        let corners = moves.topology.corners(cell).map(|n| moves.old_rest(n));
        if let Some(local) = invert(&corners, &to) {
            let outside = local
                .iter()
                .map(|v| (v - 0.5).abs() - 0.5)
                .fold(0.0, f64::max);
            if best.is_none_or(|b| outside < b.0) {
                best = Some((outside, cell, local));
            }
            if outside < 1e-9 {
                break;
            }
        }
    }
    let mut shares = [(node, 0.0); 8];
    if let Some((_, cell, local)) = best {
        let local = local.map(|v| v.clamp(-OUTSIDE_MAX, 1.0 + OUTSIDE_MAX));
        let corners = moves.topology.corners(cell);
        for (share, (n, w)) in shares
            .iter_mut()
            .zip(corners.into_iter().zip(weights(&local)))
        {
            *share = (n, w);
        }
    } else {
        shares[0].1 = 1.0;
    }
    Moved {
        node,
        weights: shares,
    }
}

impl Shape {
    /// Takes over a cut that was made in its topology: one displacement per node again, and no node
    /// jumps. Call it once per cut, in order, with the topology as the cut left it. After a return to fewer cuts the
    /// displacements of the nodes that are gone are dropped.
    pub(crate) fn follow(&mut self, topology: &Topology, outcome: &CutOutcome) {
        let first = outcome.doubled.first();
        let remaining = first.map_or(topology.node_count(), |d| d.0 as usize);
        self.displacement.truncate(remaining);
        let taken: Vec<Vec3> = outcome
            .moved
            .iter()
            .map(|m| {
                let share = |&(n, w): &(u32, f64)| self.displacement[n as usize] * w;
                m.weights.iter().map(share).sum()
            })
            .collect();
        for (m, displacement) in outcome.moved.iter().zip(taken) {
            if !topology.is_pinned(m.node) {
                self.displacement[m.node as usize] = displacement;
            }
        }
        for &(new, from) in &outcome.doubled {
            debug_assert_eq!(new as usize, self.displacement.len());
            self.displacement.push(self.displacement[from as usize]);
        }
    }
}
