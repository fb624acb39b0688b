//! The active set: the refined elements of level 1 and their bricks.

use super::brick::LOCALS;
use super::coarse_level::{CoarseLevel, List};
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces, SetChange};
use super::hierarchy::Hierarchy;
use super::mechanism::Mechanism;
use super::quad::square;
use crate::Vec3;

/// Fraction of the threshold below which a force is ignored, in quick and in full steps.
const SILENT: [f32; 2] = [0.02, 1e-4];

/// Factor by which the set may exceed the required elements before it is rebuilt.
const ROOMY: usize = 2;

/// Criteria of a choice.
pub(super) struct Criteria {
    /// Force in N from which a node requires refinement.
    pub(super) threshold: f32,
    /// Whether the step is quick.
    pub(super) quick: bool,
    /// Whether all elements stay, within a quick step; otherwise only the strained ones and those near the required ones.
    pub(super) keeps_all: bool,
    /// Part of the set that fits in the work limit.
    pub(super) fitting: f64,
}

impl FineLevel {
    /// Chooses the elements of level 1 to refine: those with a node whose force exceeds the threshold, those marked by
    /// the last cycle, and those in contact. The current set stays if it covers them and is not much larger. Returns
    /// whether the set changes.
    pub(super) fn select(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &mut Multigrid,
        always: impl Iterator<Item = u32>,
        criteria: &Criteria,
        u: &[Vec3],
    ) -> bool {
        let Criteria {
            threshold,
            quick,
            keeps_all,
            fitting,
        } = *criteria;
        for &node in &self.nodes.items {
            self.unbalanced.insert(node);
        }
        if !quick {
            for node in self.below_threshold.take() {
                self.unbalanced.insert(node);
                self.outer_forces = OuterForces::Changed;
            }
        }
        self.collect_required(hierarchy, &coarse.grids[0], threshold, quick);
        for node in always {
            for &entry in hierarchy.around.row(node) {
                let element = hierarchy.element_of[(entry / 32) as usize];
                self.required.insert(element);
            }
        }
        let silent = SILENT[usize::from(!quick)] * threshold;
        let (r, below_threshold, nodes) = (&self.r, &mut self.below_threshold, &self.nodes);
        let outer = &mut self.outer_forces;
        self.unbalanced.retain(|node| {
            let stays = square(&r[node as usize]) > silent * silent;
            if quick && !stays {
                below_threshold.insert(node);
            }
            if !stays && !nodes.contains(node) {
                *outer = OuterForces::Changed;
            }
            stays
        });
        self.disturbed.clear();
        let to_refine = coarse.grids.iter().any(|p| !p.to_refine.items.is_empty());
        let (refined, required) = (&coarse.grids[0].refined, &self.required);
        let covered = required.items.iter().all(|&e| refined.contains(e));
        let roomy = !keeps_all && refined.items.len() / ROOMY > required.items.len();
        if covered && !roomy && !to_refine && !self.outdated {
            return false;
        }
        self.outdated = false;
        let grid = &mut coarse.grids[0];
        if !keeps_all {
            self.retain_most_strained(hierarchy, &mut grid.refined, fitting, u);
        }
        for &element in &self.required.items {
            grid.refined.insert(element);
        }
        Self::refine_marked(grid);
        true
    }

    /// Keeps the elements of level 1 that are too deformed for their matrix at rest, and of these only the most deformed
    /// ones if more than the `fitting` part of the set would stay.
    fn retain_most_strained(
        &self,
        hierarchy: &Hierarchy,
        refined: &mut List,
        fitting: f64,
        u: &[Vec3],
    ) {
        let limit = f64::from(self.keep_strained) * 2.0 / f64::from(hierarchy.per_spacing);
        let most = (fitting * refined.items.len() as f64) as usize;
        let all = refined.items.iter();
        let mut strained: Vec<(u32, f64)> = all.map(|&e| (e, change(hierarchy, e, u))).collect();
        refined.clear();
        strained.retain(|s| s.1 > limit);
        if strained.len() > most {
            strained.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            strained.truncate(most);
        }
        for (element, _) in strained {
            refined.insert(element);
        }
    }

    /// Collects the elements around nodes whose force exceeds the threshold.
    fn collect_required(
        &mut self,
        hierarchy: &Hierarchy,
        grid: &CoarseLevel,
        threshold: f32,
        quick: bool,
    ) {
        self.required.clear();
        let waits = |&entry: &u32| {
            let element = hierarchy.element_of[(entry / 32) as usize];
            grid.has_pending[element as usize]
        };
        for &node in &self.unbalanced.items {
            let n = node as usize;
            if self.fixed[n] || square(&self.r[n]) <= threshold * threshold {
                continue;
            }
            // Beside a deferred element only half of the force is known; the coarse level has solved the rest.
            let around = hierarchy.around.row(node);
            let known = !quick
                || !self.disabled.allows(Mechanism::KnownForces)
                || self.free[n]
                || self.disturbed.contains(node)
                || !self.nodes.contains(node) && !around.iter().any(waits);
            if known {
                for &entry in around {
                    self.required
                        .insert(hierarchy.element_of[(entry / 32) as usize]);
                }
            }
        }
    }

    /// Refines the marked elements of level 1.
    pub(super) fn refine_marked(grid: &mut CoarseLevel) {
        for element in grid.to_refine.take() {
            grid.refined.insert(element);
        }
        grid.refined.sort();
    }

    /// Activates the chosen set and computes its new bricks, without contact forces.
    pub(super) fn enter(&mut self, hierarchy: &Hierarchy, coarse: &Multigrid, u: &mut [Vec3]) {
        self.activate(hierarchy, coarse, u);
        let new = |brick: &u32| !self.left.contains(*brick);
        let new: Vec<u32> = self.set.items.iter().copied().filter(new).collect();
        self.compute(hierarchy, u, &new);
        self.update_block_sums(hierarchy, u, &new);
        self.sum_up(hierarchy);
    }

    /// Activates the chosen set and brings its nodes up to date with level 1, without computing forces.
    pub(super) fn activate(&mut self, hierarchy: &Hierarchy, coarse: &Multigrid, u: &mut [Vec3]) {
        self.mark_applied(hierarchy, coarse);
        self.since = SetChange::Replaced;
        self.outer_forces = OuterForces::Changed;
        std::mem::swap(&mut self.set, &mut self.left);
        self.set.clear();
        for &node in &self.nodes.items {
            self.inside[node as usize] = 0;
            self.free[node as usize] = false;
        }
        self.nodes.clear();
        for &element in &coarse.grids[0].refined.items {
            for &brick in hierarchy.levels[0].children.row(element) {
                self.set.insert(brick);
            }
        }
        for &brick in &self.set.items {
            let b = &hierarchy.bricks[brick as usize];
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
            self.unbalanced.insert(node);
            self.free[n] = !self.fixed[n] && self.inside[n] == hierarchy.around.len(node);
            self.follow_coarser(hierarchy, coarse, u, node);
        }
        self.current = false;
    }
}

/// Largest change of size of a brick of an element of level 1 along an axis, in m.
fn change(hierarchy: &Hierarchy, element: u32, u: &[Vec3]) -> f64 {
    let bricks = hierarchy.levels[0].children.row(element).iter();
    bricks.fold(0.0, |most, &b| f64::max(most, hierarchy.change_of(b, u)))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::solver::Solver;
    use super::*;
    use crate::{Budget, Material, Shape, Tool, Topology, block};

    #[test]
    fn new_set_keeps_the_most_strained_elements_that_fit() {
        let material = Material {
            young_pa: 10e3,
            poisson: 0.45,
            ..Material::default()
        };
        let topology = Topology::new(Arc::new(block([24, 24, 10], 2e-3, &material, 1)));
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        for k in 1..=15 {
            let centre = Vec3::new(24e-3, 24e-3, 28e-3 - 0.4e-3 * f64::from(k));
            let budget = Budget {
                near: true,
                ..Budget::new(1, 0.02)
            };
            solver.step(
                &topology,
                &mut shape,
                &[Tool::ball(1, centre, 8e-3)],
                budget,
            );
        }
        let (hierarchy, u) = (&solver.hierarchy, &shape.displacement);
        let all = &solver.coarse.grids[0].refined.items;
        let kept = |fitting| {
            let mut list = List::new(hierarchy.levels[0].corners.len());
            for &element in all {
                list.insert(element);
            }
            let fine = &solver.fine;
            fine.retain_most_strained(hierarchy, &mut list, fitting, u);
            list
        };
        let strained = kept(f64::INFINITY);
        let count = strained.items.len();
        assert!(count > 10 && count < all.len(), "{count} of {}", all.len());
        let few = kept(0.5 * count as f64 / all.len() as f64);
        assert_eq!(few.items.len(), count / 2);
        let changes = few.items.iter().map(|&e| change(hierarchy, e, u));
        let least = changes.fold(f64::MAX, f64::min);
        for &element in strained.items.iter().filter(|&&e| !few.contains(e)) {
            assert!(change(hierarchy, element, u) <= least);
        }
    }
}
