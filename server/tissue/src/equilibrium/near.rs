//! What lies directly under the tools: a few bricks whose nodes are smoothed more often than the others.
//!
//! A contact is forty times as stiff as the tissue, so a node that a correction has left a little off its
//! place shows as a large force. What is to be mended there is local. (Three such steps took 0.065 ms of a tick
//! of 1.3 ms: not much less than three over all, because of the contacts' own share.)

use super::field::Field;
use super::patch::List;
use super::structure::Structure;
use crate::Vec3;
use crate::contact::Contacts;

/// Bricks around nodes in contact, and the nodes that have no others around them.
pub(super) struct Near {
    bricks: List,
    seen: List,
    pub(super) nodes: Vec<u32>,
}

impl Near {
    pub(super) fn new(structure: &Structure) -> Self {
        Self {
            bricks: List::new(structure.bricks.len()),
            seen: List::new(structure.prolongation.len()),
            nodes: Vec::new(),
        }
    }

    /// Takes what is under these contacts.
    fn gather(&mut self, structure: &Structure, field: &Field, contacts: &Contacts) {
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

impl Field {
    /// Smooths what is under the tools, with `steps` steps.
    pub(super) fn smooth_near(
        &mut self,
        structure: &Structure,
        near: &mut Near,
        u: &mut [Vec3],
        contacts: &Contacts,
        steps: usize,
    ) {
        near.gather(structure, self, contacts);
        // Their blocks are those of the smoothing before, after the correction: with blocks of before the correction
        // steps blew up where tissue has become much stiffer since.
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
