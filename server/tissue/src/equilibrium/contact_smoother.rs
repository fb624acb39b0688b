//! Additional smoothing of the bricks under the tools.
//!
//! A contact is many times stiffer than the tissue, so a small displacement error of a node in contact makes a large
//! force error. The error is local, so local smoothing removes it. (Three steps take 0.065 ms of a tick of 1.3 ms.)

use super::coarse_level::List;
use super::fine_level::FineLevel;
use super::hierarchy::Hierarchy;
use super::smoothing::EigenvalueBound;
use crate::Vec3;
use crate::contact::Contacts;

/// Bricks around nodes in contact, and the nodes inside these bricks.
pub(super) struct ContactSmoother {
    bricks: List,
    seen: List,
    pub(super) nodes: Vec<u32>,
}

impl ContactSmoother {
    pub(super) fn new(hierarchy: &Hierarchy) -> Self {
        Self {
            bricks: List::new(hierarchy.bricks.len()),
            seen: List::new(hierarchy.prolongation.len()),
            nodes: Vec::new(),
        }
    }

    /// Takes the bricks and nodes of a changed hierarchy from now on.
    pub(super) fn follow(&mut self, hierarchy: &Hierarchy) {
        self.bricks.clear();
        self.seen.clear();
        self.nodes.clear();
        self.bricks.shrink(hierarchy.bricks.len());
        self.bricks.grow(hierarchy.bricks.len());
        self.seen.shrink(hierarchy.prolongation.len());
        self.seen.grow(hierarchy.prolongation.len());
    }

    /// Collects the bricks under these contacts.
    fn gather(&mut self, hierarchy: &Hierarchy, fine: &FineLevel, contacts: &Contacts) {
        self.bricks.clear();
        self.seen.clear();
        self.nodes.clear();
        for &node in &contacts.nodes {
            for &entry in hierarchy.around.row(node) {
                self.bricks.insert(entry / 32);
            }
        }
        self.bricks.sort();
        for &brick in &self.bricks.items {
            for &node in &hierarchy.bricks[brick as usize].nodes {
                let within = |entry: &u32| self.bricks.contains(*entry / 32);
                if fine.free[node as usize]
                    && self.seen.insert(node)
                    && hierarchy.around.row(node).iter().all(within)
                {
                    self.nodes.push(node);
                }
            }
        }
    }
}

impl FineLevel {
    /// Smooths the nodes under the tools with `steps` Chebyshev steps.
    pub(super) fn smooth_contacts(
        &mut self,
        hierarchy: &Hierarchy,
        smoother: &mut ContactSmoother,
        u: &mut [Vec3],
        contacts: &Contacts,
        steps: usize,
    ) {
        smoother.gather(hierarchy, self, contacts);
        // The diagonal blocks are those of the last smoothing, after the correction. Older blocks made the iteration
        // diverge where tissue had stiffened.
        let mut factors = hierarchy.smoothing.factors(EigenvalueBound::BLOCKS);
        for _ in 0..steps {
            self.compute(hierarchy, u, &smoother.bricks.items);
            for &node in &smoother.nodes {
                self.r[node as usize] = self.sum(hierarchy, node);
            }
            for &node in &contacts.nodes {
                self.r[node as usize] = self.sum(hierarchy, node);
            }
            self.add_contacts_and_blocks(u, contacts);
            self.relax(u, &smoother.nodes, &mut factors);
        }
    }
}
