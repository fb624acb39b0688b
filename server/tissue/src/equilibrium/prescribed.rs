//! Nodes with a prescribed displacement: Dirichlet conditions that change from step to step.

use super::fine_level::OuterForces;
use super::solver::Solver;
use crate::{Shape, Topology, Vec3};

/// Maximum of nodes held at once; [`Tissue::hold`](crate::Tissue::hold) rejects more. 4096 nodes are a surface of 25 cm square at 4 mm.
const HELD_MAX: usize = 4096;

impl Solver {
    pub(crate) fn hold(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        node: u32,
        at: Vec3,
    ) -> bool {
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
        self.fine.outdated |= !self.fine.fixed[n];
        self.fine.fixed[n] = true;
        self.fine.outer_forces = OuterForces::Changed;
        self.prescribed_from
            .entry(node)
            .or_insert(shape.displacement[n]);
        shape.displacement[n] = at;
        self.disturb(shape, [node]);
        true
    }
}
