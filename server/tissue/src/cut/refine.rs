//! Refinement after snapping (Lin 2007, fig. 5.10; reconstructed): the free nodes around a cut share
//! what its own nodes had to move.
//!
//! With o = x - x_model a node's offset from where the model was built, each free node within three
//! rings of the cut takes the mean of its neighbours' offsets, sweep after sweep, while its cells
//! stay sound. Nodes of the cut, of surfaces and of interfaces stay where they are. Irregularities
//! of the model itself are in x_model and are kept.

use std::collections::BTreeSet;

use super::quality::Moves;
use super::snap::{Freedom, freedom};
use crate::{NO_CELL, Topology, Vec3};

/// How many rings of neighbours around the cut take part.
const RINGS: usize = 3;
/// Most sweeps; what has not settled then stays as it is.
pub(crate) const SWEEPS_MAX: usize = 50;
/// A sweep in which no node moved farther, in spacings, is the last.
const SETTLED: f64 = 1e-3;

/// The free nodes around a cut, with their neighbours.
pub(crate) struct Surroundings {
    nodes: Vec<(u32, Vec3, Vec<u32>)>,
}

impl Surroundings {
    pub(crate) fn of(topology: &Topology, sheet: &[u32]) -> Self {
        let mut seen: BTreeSet<u32> = sheet.iter().copied().collect();
        let mut front: Vec<u32> = sheet.to_vec();
        let mut nodes = Vec::new();
        for _ in 0..RINGS {
            let mut next = BTreeSet::new();
            for &node in &front {
                next.extend(
                    neighbours(topology, node)
                        .into_iter()
                        .filter(|n| !seen.contains(n)),
                );
            }
            seen.extend(&next);
            front = next.into_iter().collect();
            for &node in &front {
                if freedom(topology, node) == Freedom::Free {
                    let original = topology.original(node);
                    nodes.push((node, original, neighbours(topology, node)));
                }
            }
        }
        Self { nodes }
    }

    /// One sweep; gives the farthest move in m.
    pub(crate) fn sweep(&self, moves: &mut Moves<'_>) -> f64 {
        let quiet = SETTLED / 4.0 * moves.topology.model.spacing_m;
        let mut farthest: f64 = 0.0;
        for (node, original, neighbours) in &self.nodes {
            let sum: Vec3 = neighbours
                .iter()
                .map(|&n| moves.rest(n) - moves.topology.original(n))
                .sum();
            let target = original + sum / neighbours.len() as f64;
            let way = (target - moves.rest(*node)).norm();
            if way > quiet {
                farthest = farthest.max(way * moves.advance(*node, target));
            }
        }
        farthest
    }

    /// Sweeps until settled.
    pub(crate) fn relax(&self, moves: &mut Moves<'_>, sweeps: usize) {
        let settled = SETTLED * moves.topology.model.spacing_m;
        for _ in 0..sweeps {
            if self.sweep(moves) < settled {
                break;
            }
        }
    }
}

/// The nodes at the other ends of a node's edges, sorted.
fn neighbours(topology: &Topology, node: u32) -> Vec<u32> {
    let cells = topology.node_cells[node as usize];
    let mut list = Vec::with_capacity(24);
    for (slot, &cell) in cells.iter().enumerate().filter(|c| *c.1 != NO_CELL) {
        list.extend([1, 2, 4].map(|step| topology.corners(cell)[slot ^ step]));
    }
    list.sort_unstable();
    list.dedup();
    list
}
