//! The active set: the refined elements of level 1 and their bricks.

use super::brick::LOCALS;
use super::coarse_level::CoarseLevel;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces, Since, square};
use super::hierarchy::Hierarchy;
use crate::Vec3;

/// Fraction of the threshold below which a force is ignored, in quick and in full steps.
const SILENT: [f32; 2] = [0.02, 1e-4];
/// Maximum elements that unbalanced nodes may add in a quick step; the largest forces come first. A millisecond
/// suffices for about two thousand nodes.
const NEEDED_MAX: usize = 160;

/// Rule by which elements stay in the set.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Keeps {
    /// All stay, within a quick step.
    All,
    /// Most stay, because the warm start includes them.
    Most,
    /// Only elements near the required ones stay.
    Near,
}

impl Keeps {
    /// Factor by which the set may exceed the required elements before it is rebuilt.
    fn most(self) -> usize {
        match self {
            Self::All => usize::MAX,
            Self::Most => 1000,
            Self::Near => 2,
        }
    }
}

/// Criteria of a choice.
pub(super) struct Criteria {
    /// Force in N from which a node requires refinement.
    pub(super) threshold: f32,
    /// Whether the step is quick.
    pub(super) quick: bool,
    pub(super) keeps: Keeps,
}

impl FineLevel {
    /// Chooses the elements of level 1 to refine: those with a node whose force exceeds the threshold, those marked by
    /// the last cycle, and those in contact. The current set stays if it covers them and is not much larger. Returns
    /// whether the set changes.
    pub(super) fn select(
        &mut self,
        structure: &Hierarchy,
        coarse: &mut Multigrid,
        always: impl Iterator<Item = u32>,
        asked: &Criteria,
        u: &[Vec3],
    ) -> bool {
        let Criteria {
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
                self.beyond = OuterForces::Changed;
            }
        }
        let mut limit = threshold;
        loop {
            self.need(structure, &coarse.patches[0], limit, quick);
            // NaN forces exceed any limit; the step is undone because of them.
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
                *beyond = OuterForces::Changed;
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

    /// Whether an element of level 1 is too deformed for its matrix at rest.
    fn is_bent(&self, structure: &Hierarchy, element: u32, u: &[Vec3]) -> bool {
        let tolerable = f64::from(self.bent) * 2.0 / f64::from(structure.per_spacing);
        let bricks = structure.levels[0].children.row(element);
        bricks
            .iter()
            .any(|&brick| structure.change_of(brick, u) > tolerable)
    }

    /// Collects the elements around nodes whose force exceeds the threshold.
    fn need(&mut self, structure: &Hierarchy, patch: &CoarseLevel, threshold: f32, quick: bool) {
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
            // Beside a deferred element only half of the force is known; the coarse level has solved the rest.
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

    /// Refines the marked elements of level 1.
    pub(super) fn select_wanted(patch: &mut CoarseLevel) {
        for element in patch.wanted.take() {
            patch.refined.insert(element);
        }
        patch.refined.sort();
    }

    /// Activates the chosen set and computes its new bricks, without contact forces.
    pub(super) fn enter(&mut self, structure: &Hierarchy, coarse: &Multigrid, u: &mut [Vec3]) {
        self.take_in(structure, coarse, u);
        let new = |brick: &u32| !self.left.contains(*brick);
        let new: Vec<u32> = self.set.items.iter().copied().filter(new).collect();
        self.compute(structure, u, &new);
        self.renew_firmness(structure, u, &new);
        self.sum_up(structure);
    }

    /// Activates the chosen set and brings its nodes up to date with level 1, without computing forces.
    pub(super) fn take_in(&mut self, structure: &Hierarchy, coarse: &Multigrid, u: &mut [Vec3]) {
        self.note(structure, coarse);
        self.since = Since::Chosen;
        self.beyond = OuterForces::Changed;
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
