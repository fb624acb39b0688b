//! Additional smoothing of the bricks under the tools.
//!
//! A contact is forty times stiffer than the tissue, so a small displacement error of a node in contact makes a large
//! force error. The error is local, so local smoothing removes it. (Three steps take 0.065 ms of a tick of 1.3 ms.)

use super::coarse_level::List;
use super::fine_level::FineLevel;
use super::hierarchy::Hierarchy;
use crate::Vec3;
use crate::contact::Contacts;

/// Bricks around nodes in contact, and the nodes inside these bricks.
pub(super) struct ContactSmoother {
    bricks: List,
    seen: List,
    pub(super) nodes: Vec<u32>,
}

impl ContactSmoother {
    pub(super) fn new(structure: &Hierarchy) -> Self {
        Self {
            bricks: List::new(structure.bricks.len()),
            seen: List::new(structure.prolongation.len()),
            nodes: Vec::new(),
        }
    }

    /// Collects the bricks under these contacts.
    fn gather(&mut self, structure: &Hierarchy, field: &FineLevel, contacts: &Contacts) {
        self.bricks.clear();
        self.seen.clear();
        self.nodes.clear();
        for &node in &contacts.nodes {
            for &entry in structure.around.row(node) {
                self.bricks.insert(entry / 32);
            }
        }
        self.bricks.sort();
        for &brick in &self.bricks.items {
            for &node in &structure.bricks[brick as usize].nodes {
                let within = |entry: &u32| self.bricks.contains(*entry / 32);
                if field.free[node as usize]
                    && self.seen.insert(node)
                    && structure.around.row(node).iter().all(within)
                {
                    self.nodes.push(node);
                }
            }
        }
    }
}

impl FineLevel {
    /// Smooths the nodes under the tools with `steps` Chebyshev steps.
    pub(super) fn smooth_near(
        &mut self,
        structure: &Hierarchy,
        near: &mut ContactSmoother,
        u: &mut [Vec3],
        contacts: &Contacts,
        steps: usize,
    ) {
        near.gather(structure, self, contacts);
        // The diagonal blocks are those of the last smoothing, after the correction. Older blocks made the iteration
        // diverge where tissue had stiffened.
        let mut factors = Self::smoothing();
        for _ in 0..steps {
            self.compute(structure, u, &near.bricks.items);
            for &node in &near.nodes {
                self.r[node as usize] = self.sum(structure, node);
            }
            for &node in &contacts.nodes {
                self.r[node as usize] = self.sum(structure, node);
            }
            self.press(u, contacts);
            self.relax(u, &near.nodes, &mut factors);
        }
    }
}
