//! Refinement after snapping (Lin 2007, fig. 5.10; reconstructed): the free nodes around a cut share
//! what its own nodes had to move.
//!
//! With o = x - X a node's offset from where it was built, X, each free node within three
//! rings of the cut takes the mean of its neighbours' offsets, sweep after sweep (successive over-relaxation). Nodes of
//! the cut, of surfaces and of interfaces stay where they are. Irregularities of the model itself are in
//! X and are kept.

use std::ops::Range;

use super::freedom::Freedom;
use super::patch::{Patch, within_drift};
use crate::cell::NO_CELL;
use crate::{Topology, Vec3};

/// Most sweeps; what has not settled then stays as it is.
const SWEEPS_MAX: usize = 50;
/// A sweep in which no node moved farther, in spacings, is the last.
const SETTLED: f64 = 0.05 * WORTH_MOVING;
/// Over-relaxation, near the best for three rings.
const OVER: f64 = 1.4;
/// A node that would move less than this, in spacings, stays. Each moved node costs the forms and matrices of its cells; with
/// 0.1 the mean quality of the cells around a cut falls instead of rising, because neighbours of moved nodes stay behind.
const WORTH_MOVING: f64 = 0.05;

impl Patch {
    /// Relaxes the offsets of the nodes around the sheet and moves these along.
    pub(crate) fn relax(&mut self, topology: &Topology) {
        let original: Vec<Vec3> = self.ids.iter().map(|&n| topology.original(n)).collect();
        let mut offsets: Vec<Vec3> = self.at.iter().zip(&original).map(|(x, o)| x - o).collect();
        let mut links: Vec<u32> = Vec::new();
        let mut nodes: Vec<(usize, Range<usize>)> = Vec::new();
        for n in (self.sheet..self.movable).filter(|&n| self.holds[n] == Freedom::Free) {
            let from = links.len();
            self.append_neighbours(n, &mut links);
            nodes.push((n, from..links.len()));
        }
        for _ in 0..SWEEPS_MAX {
            let mut farthest: f64 = 0.0;
            for (i, own) in &nodes {
                let (i, links) = (*i, &links[own.clone()]);
                let sum: Vec3 = links.iter().map(|&j| offsets[j as usize]).sum();
                let way = (sum / links.len() as f64 - offsets[i]) * OVER;
                farthest = farthest.max(way.norm_squared());
                offsets[i] += way;
            }
            if farthest.sqrt() < SETTLED * self.spacing {
                break;
            }
        }
        for (n, _) in nodes {
            let to = within_drift(original[n] + offsets[n], &original[n], self.spacing);
            if (to - self.start[n]).norm() > WORTH_MOVING * self.spacing {
                self.at[n] = to;
            }
        }
    }

    /// Appends the nodes at the other ends of a node's edges, sorted.
    fn append_neighbours(&self, node: usize, list: &mut Vec<u32>) {
        let from = list.len();
        for (slot, &cell) in self.around[node].iter().enumerate() {
            if cell != NO_CELL {
                for step in [1, 2, 4] {
                    let other = self.cells[cell as usize][slot ^ step];
                    if !list[from..].contains(&other) {
                        list.push(other);
                    }
                }
            }
        }
        list[from..].sort_unstable();
    }
}
