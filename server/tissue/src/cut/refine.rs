//! Refinement after snapping (Lin 2007, fig. 5.10; reconstructed): the free nodes around a cut share
//! what its own nodes had to move.
//!
//! With o = x - X a node's offset from where it was built, X, each free node within three
//! rings of the cut takes the mean of its neighbours' offsets, sweep after sweep. Nodes of the cut,
//! of surfaces and of interfaces stay where they are. Irregularities of the model itself are in
//! X and are kept. The sweeps run on offsets alone; then the nodes go there, each as far as its
//! cells stay sound, a few times over because they make room for each other.

use std::collections::{BTreeSet, HashMap};

use super::bounded_moves::Moves;
use super::sheet_snap::{Freedom, freedom};
use crate::cell::NO_CELL;
use crate::{Topology, Vec3};

/// How many rings of neighbours around the cut take part.
const RINGS: usize = 3;
/// Most sweeps; what has not settled then stays as it is.
const SWEEPS_MAX: usize = 50;
/// A sweep in which no node moved farther, in spacings, is the last.
const SETTLED: f64 = 1e-3;
/// A node that would move less than this, in spacings, stays: moving it costs more than it gains.
const WORTH_MOVING: f64 = 5e-3;
/// How often the nodes try to reach their places.
const PASSES: usize = 2;

/// The free nodes around a cut, with their neighbours.
pub(crate) struct Surroundings {
    /// The free nodes, then those they lean on; each with where it was built.
    nodes: Vec<(u32, Vec3)>,
    /// Positions in `nodes` of the neighbours of each free node.
    links: Vec<Vec<u32>>,
}

impl Surroundings {
    pub(crate) fn of(topology: &Topology, sheet: &[u32]) -> Self {
        let mut seen: BTreeSet<u32> = sheet.iter().copied().collect();
        let mut front: Vec<u32> = sheet.to_vec();
        let mut free = Vec::new();
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
            free.extend(
                front
                    .iter()
                    .filter(|&&n| freedom(topology, n) == Freedom::Free),
            );
        }
        let around: Vec<Vec<u32>> = free.iter().map(|&n| neighbours(topology, n)).collect();
        let mut nodes: Vec<(u32, Vec3)> = Vec::with_capacity(2 * free.len());
        let mut places = HashMap::with_capacity(2 * free.len());
        let mut place = |node: u32| {
            *places.entry(node).or_insert_with(|| {
                nodes.push((node, topology.original(node)));
                nodes.len() as u32 - 1
            })
        };
        for &node in &free {
            place(node);
        }
        let links = around
            .into_iter()
            .map(|list| list.into_iter().map(&mut place).collect())
            .collect();
        Self { nodes, links }
    }

    /// Relaxes the offsets and moves the nodes along.
    pub(crate) fn relax(&self, moves: &mut Moves<'_>) {
        let spacing = moves.topology.model.spacing_m;
        let mut offsets: Vec<Vec3> = self.nodes.iter().map(|n| moves.rest(n.0) - n.1).collect();
        for _ in 0..SWEEPS_MAX {
            let mut farthest: f64 = 0.0;
            for (i, links) in self.links.iter().enumerate() {
                let sum: Vec3 = links.iter().map(|&j| offsets[j as usize]).sum();
                let mean = sum / links.len() as f64;
                farthest = farthest.max((mean - offsets[i]).norm_squared());
                offsets[i] = mean;
            }
            if farthest.sqrt() < SETTLED * spacing {
                break;
            }
        }
        for _ in 0..PASSES {
            for ((node, original), offset) in self.nodes.iter().zip(&offsets).take(self.links.len())
            {
                let target = original + offset;
                if (target - moves.rest(*node)).norm() > WORTH_MOVING * spacing {
                    moves.advance(*node, target);
                }
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
