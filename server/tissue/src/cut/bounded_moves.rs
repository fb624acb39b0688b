//! How far a node may move before a cell goes bad, and the moving.
//!
//! A cell is sound while the three edges at each of its corners span a positive volume (its corner
//! Jacobian) and none of its springs is too short. A move may not take a corner or a spring below
//! its floor, unless it was there before and the move makes it better.

use std::collections::HashMap;

use super::DRIFT_MAX;
use super::soundness::{CORNER_FLOOR, SPRING_FLOOR, span};
use crate::cell::NO_CELL;
use crate::{Topology, Vec3};

/// Halvings in the search for how much of a move is allowed: to 1/64 of it.
const HALVINGS: u32 = 6;

/// A topology whose nodes are being moved, with where they were.
pub(crate) struct Moves<'a> {
    pub(crate) topology: &'a mut Topology,
    /// Rest position before the cut of each node that has moved.
    pub(crate) old: HashMap<u32, Vec3>,
}

impl Moves<'_> {
    pub(crate) fn rest(&self, node: u32) -> Vec3 {
        self.topology.rest(node)
    }

    /// Where a node was before this cut.
    pub(crate) fn old_rest(&self, node: u32) -> Vec3 {
        let moved = self.old.get(&node).copied();
        moved.unwrap_or_else(|| self.topology.rest(node))
    }

    /// Moves a node towards a place as far as its cells allow; gives the part of the way it went.
    pub(crate) fn advance(&mut self, node: u32, target: Vec3) -> f64 {
        let from = self.rest(node);
        if target == from {
            return 1.0;
        }
        let mut good = 0.0;
        if self.allowed(node, target) {
            good = 1.0;
        } else {
            let mut step = 0.5;
            for _ in 0..HALVINGS {
                if self.allowed(node, from + (target - from) * (good + step)) {
                    good += step;
                }
                step /= 2.0;
            }
        }
        if good > 0.0 {
            self.old.entry(node).or_insert(from);
            self.topology.rest[node as usize] = if good == 1.0 {
                target
            } else {
                from + (target - from) * good
            };
        }
        good
    }

    /// Whether all cells around a node stay sound when it moves.
    fn allowed(&self, node: u32, to: Vec3) -> bool {
        let topology = &*self.topology;
        let spacing = topology.model.spacing_m;
        let original = topology.original(node);
        let drift = (to - original).norm();
        if drift > DRIFT_MAX * spacing && drift > (self.rest(node) - original).norm() {
            return false;
        }
        let corner_floor = CORNER_FLOOR * spacing.powi(3);
        let spring_floor = (SPRING_FLOOR * spacing).powi(2);
        let cells = topology.node_cells[node as usize];
        cells
            .iter()
            .enumerate()
            .filter(|c| *c.1 != NO_CELL)
            .all(|(slot, &cell)| {
                let before = topology.corners(cell).map(|n| topology.rest(n));
                let mut after = before;
                after[slot] = to;
                let sound = |corner: usize| {
                    let volume = span(&after, corner);
                    volume >= corner_floor || volume > span(&before, corner)
                };
                let long = |step: usize| {
                    let other = before[slot ^ step];
                    let length = (other - to).norm_squared();
                    length >= spring_floor || length > (other - before[slot]).norm_squared()
                };
                [0, 1, 2, 4].iter().all(|step| sound(slot ^ step)) && (1..8).all(long)
            })
    }
}

impl Topology {
    /// The node of the model as built that a node is or was doubled from; itself where it has no cell.
    pub(crate) fn origin(&self, node: u32) -> u32 {
        let cells = self.node_cells[node as usize];
        let slot = cells.iter().position(|&c| c != NO_CELL);
        slot.map_or(node, |s| self.model.cells[cells[s] as usize].corners[s])
    }

    /// Where a node, or the node that it was doubled from, stood in the model as built.
    pub(crate) fn original(&self, node: u32) -> Vec3 {
        let known = self.model.nodes.get(self.origin(node) as usize);
        known.copied().unwrap_or_else(|| self.rest(node))
    }
}
