//! What takes part in a step: the elements of level 1 that are refined, and their bricks.

use super::brick::LOCALS;
use super::cycle::Multigrid;
use super::field::{Beyond, Field, Since, square};
use super::patch::Patch;
use super::structure::Structure;
use crate::Vec3;

/// Part of the threshold below which a force is forgotten, when a hand waits for the answer and
/// when not.
const SILENT: [f32; 2] = [0.02, 1e-4];
/// Elements that loud nodes may have refined while a hand waits. Where more are loud, the loudest have
/// their turn first: two thousand nodes are what a millisecond has room for.
const NEEDED_MAX: usize = 160;

/// What stays in the set when it is looked at.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Keeps {
    /// All, while a hand's step goes on.
    All,
    /// Much of it, because its change is carried on.
    Most,
    /// What is near.
    Near,
}

impl Keeps {
    /// How many times more elements than need to may take part before they are chosen afresh.
    fn most(self) -> usize {
        match self {
            Self::All => usize::MAX,
            Self::Most => 1000,
            Self::Near => 2,
        }
    }
}

/// What a choice goes by.
pub(super) struct Asked {
    /// Force in N from which on a node is loud.
    pub(super) threshold: f32,
    /// Whether a hand waits.
    pub(super) quick: bool,
    pub(super) keeps: Keeps,
}

impl Field {
    /// Chooses what takes part: the elements of level 1 to refine are those with a node whose force
    /// is above the threshold, those wanted by the last cycle, and those in contact. What is
    /// refined already stays as it is while it covers them and is not much more. Returns whether
    /// there is a choice to be taken.
    pub(super) fn select(
        &mut self,
        structure: &Structure,
        coarse: &mut Multigrid,
        always: impl Iterator<Item = u32>,
        asked: &Asked,
        u: &[Vec3],
    ) -> bool {
        let Asked {
            threshold,
            quick,
            keeps,
        } = *asked;
        for &node in &self.nodes.items {
            self.loud.insert(node);
        }
        if !quick {
            for node in self.quiet.take() {
                self.loud.insert(node);
                self.beyond = Beyond::Changed;
            }
        }
        let mut limit = threshold;
        loop {
            self.need(structure, &coarse.patches[0], limit, quick);
            // Forces that are no numbers are louder than any limit; the step is undone for them.
            if !quick || self.needed.items.len() <= NEEDED_MAX || !limit.is_finite() {
                break;
            }
            limit *= 2.0;
        }
        for node in always {
            for &entry in structure.around.row(node) {
                let element = structure.element_of[(entry / 32) as usize];
                self.needed.insert(element);
            }
        }
        let silent = SILENT[usize::from(!quick)] * threshold;
        let (r, quiet, nodes) = (&self.r, &mut self.quiet, &self.nodes);
        let beyond = &mut self.beyond;
        self.loud.retain(|node| {
            let stays = square(&r[node as usize]) > silent * silent;
            if quick && !stays {
                quiet.insert(node);
            }
            if !stays && !nodes.contains(node) {
                *beyond = Beyond::Changed;
            }
            stays
        });
        self.disturbed.clear();
        let wanted = coarse.patches.iter().any(|p| !p.wanted.items.is_empty());
        let (refined, needed) = (&coarse.patches[0].refined, &self.needed);
        let covered = needed.items.iter().all(|&e| refined.contains(e));
        let roomy = refined.items.len() / keeps.most() > needed.items.len();
        if covered && !roomy && !wanted && !self.outdated {
            return false;
        }
        self.outdated = false;
        let patch = &mut coarse.patches[0];
        if roomy || keeps == Keeps::Near {
            let mut refined = std::mem::take(&mut patch.refined);
            refined.retain(|element| self.is_bent(structure, element, u));
            patch.refined = refined;
        }
        for &element in &self.needed.items {
            patch.refined.insert(element);
        }
        Self::select_wanted(patch);
        true
    }

    /// Whether an element of level 1 is too deformed for its matrix, which is that of the rest state.
    fn is_bent(&self, structure: &Structure, element: u32, u: &[Vec3]) -> bool {
        let tolerable = f64::from(self.bent) * 2.0 / f64::from(structure.per_spacing);
        let bricks = structure.levels[0].children.row(element);
        bricks
            .iter()
            .any(|&brick| structure.change_of(brick, u) > tolerable)
    }

    /// Notes the elements around nodes whose force is above the threshold.
    fn need(&mut self, structure: &Structure, patch: &Patch, threshold: f32, quick: bool) {
        self.needed.clear();
        let waits = |&entry: &u32| {
            let element = structure.element_of[(entry / 32) as usize];
            patch.waiting[element as usize]
        };
        for &node in &self.loud.items {
            let n = node as usize;
            if self.fixed[n] || square(&self.r[n]) <= threshold * threshold {
                continue;
            }
            // Beside a part that waits only half of the force is known, and the rest is what the
            // coarse level has seen to.
            let around = structure.around.row(node);
            let known = !quick
                || self.free[n]
                || self.disturbed.contains(node)
                || !self.nodes.contains(node) && !around.iter().any(waits);
            if known {
                for &entry in around {
                    self.needed
                        .insert(structure.element_of[(entry / 32) as usize]);
                }
            }
        }
    }

    /// Adds the elements of level 1 that want to be refined.
    pub(super) fn select_wanted(patch: &mut Patch) {
        for element in patch.wanted.take() {
            patch.refined.insert(element);
        }
        patch.refined.sort();
    }

    /// Takes the chosen set and computes the bricks that are new in it; the forces of contacts have to be
    /// added.
    pub(super) fn enter(&mut self, structure: &Structure, coarse: &Multigrid, u: &mut [Vec3]) {
        self.take_in(structure, coarse, u);
        let new = |brick: &u32| !self.left.contains(*brick);
        let new: Vec<u32> = self.set.items.iter().copied().filter(new).collect();
        self.compute(structure, u, &new);
        self.renew_firmness(structure, u, &new);
        self.sum_up(structure);
    }

    /// Takes the chosen set and brings its nodes up to date with level 1; forces are still to be computed.
    pub(super) fn take_in(&mut self, structure: &Structure, coarse: &Multigrid, u: &mut [Vec3]) {
        self.note(structure, coarse);
        self.since = Since::Chosen;
        self.beyond = Beyond::Changed;
        std::mem::swap(&mut self.set, &mut self.left);
        self.set.clear();
        for &node in &self.nodes.items {
            self.inside[node as usize] = 0;
            self.free[node as usize] = false;
        }
        self.nodes.clear();
        for &element in &coarse.patches[0].refined.items {
            for &brick in structure.levels[0].children.row(element) {
                self.set.insert(brick);
            }
        }
        for &brick in &self.set.items {
            let b = &structure.bricks[brick as usize];
            for i in 0..LOCALS {
                if b.present >> i & 1 == 1 {
                    self.nodes.insert(b.nodes[i]);
                    self.inside[b.nodes[i] as usize] += 1;
                }
            }
        }
        self.nodes.sort();
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            let n = node as usize;
            self.loud.insert(node);
            self.free[n] = !self.fixed[n] && self.inside[n] == structure.around.len(node);
            self.take_over(structure, coarse, u, node);
        }
        self.current = false;
    }
}
