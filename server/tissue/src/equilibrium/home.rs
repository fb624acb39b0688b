//! What nothing touches is at rest.
//!
//! With no tool on it and no node held, tissue is in equilibrium where every spring is as long as at rest: that
//! need not be solved for. What quick steps leave behind when a hand draws back is a shape a few tenths of a
//! millimetre off and forces all over the place where the press was, which cost the next press its accuracy, and at
//! 2 mm every later step 15 ms. So once all tools are clear of the tissue as it is at rest, it is there; a tool still
//! within what will be tissue again waits for that to come to it, as always.

use super::block::ZERO;
use super::brick::LOCALS;
use super::cycle::Multigrid;
use super::field::Field;
use super::foresight::Foresight;
use super::patch::Patch;
use super::relief::Relief;
use super::solver::Solver;
use super::structure::Structure;
use crate::{Shape, Topology, Vec3};

impl Solver {
    /// Puts the tissue to rest if nothing keeps it from there. Returns whether it moved.
    pub(super) fn go_home(&mut self, topology: &Topology, shape: &mut Shape) -> bool {
        let displaced = self.field.displaced > 0.0;
        let clear = || self.contacts.are_clear(topology, &shape.displacement);
        if !displaced || !self.held.is_empty() || !clear() {
            return false;
        }
        shape.displacement.fill(Vec3::zeros());
        self.field.rest(&self.structure);
        self.coarse.rest();
        self.contacts.rest();
        self.foresight = Foresight::default();
        self.led.clear();
        self.relief = Relief::NONE;
        self.reference = 0.0;
        self.report.reactions.clear();
        self.dirty = false;
        true
    }
}

impl Field {
    fn rest(&mut self, structure: &Structure) {
        for brick in self.computed.take() {
            self.forces[brick as usize] = [[0.0; LOCALS]; 3];
            self.firm[brick as usize] = [0.0; 6];
            for &node in &structure.bricks[brick as usize].nodes {
                self.r[node as usize] = ZERO;
            }
        }
        self.applied.fill([0.0; 3]);
        for list in [
            &mut self.loud,
            &mut self.quiet,
            &mut self.disturbed,
            &mut self.stale,
            &mut self.saved,
            &mut self.settled,
        ] {
            list.clear();
        }
        self.before.clear();
        self.current = false;
        self.outdated = true;
        self.displaced = 0.0;
    }
}

impl Multigrid {
    fn rest(&mut self) {
        self.patches.iter_mut().for_each(Patch::rest);
    }
}
