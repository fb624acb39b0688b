//! Nodes with a prescribed displacement: Dirichlet conditions that change from step to step.

use super::field::Beyond;
use super::solver::Solver;
use crate::{Shape, Topology, Vec3};

/// Nodes held at once at most; [`Solver::hold`] refuses more. Four thousand nodes are a surface of
/// 25 cm square at 4 mm.
const HELD_MAX: usize = 4096;

impl Solver {
    /// Holds a node at a displacement in m until it is let go. Returns whether it could: not a
    /// pinned node, not a displacement that is no number, not more than 4096 nodes.
    pub fn hold(&mut self, topology: &Topology, shape: &mut Shape, node: u32, at: Vec3) -> bool {
        let n = node as usize;
        if n >= shape.displacement.len() || topology.is_pinned(node) || !at.norm().is_finite() {
            return false;
        }
        if !self.held.contains(&node) {
            if self.held.len() >= HELD_MAX {
                return false;
            }
            self.held.push(node);
        }
        self.field.outdated |= !self.field.fixed[n];
        self.field.fixed[n] = true;
        self.field.beyond = Beyond::Changed;
        self.led.entry(node).or_insert(shape.displacement[n]);
        shape.displacement[n] = at;
        self.disturb(shape, &[node]);
        true
    }

    /// Lets go of a held node.
    pub fn let_go(&mut self, topology: &Topology, node: u32) {
        if let Some(i) = self.held.iter().position(|&n| n == node) {
            self.held.swap_remove(i);
            self.field.fixed[node as usize] = topology.is_pinned(node);
            self.field.beyond = Beyond::Changed;
            self.field.outdated = true;
            self.field.disturb(&self.structure, node);
            self.dirty = true;
        }
    }
}
