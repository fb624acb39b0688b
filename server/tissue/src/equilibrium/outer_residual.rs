//! Work of a correction on the part of the levels outside the active sets.
//!
//! Outer forces are restricted and answered by the coarse levels like all others. Without their work, the line search
//! would weigh the cost of an answer against half of its gain.
//!
//! A point outside the set of its level follows the coarser level by its weights, e = P e'. The work of a force f on it
//! is f · P e' = Pᵀ f · e', so the forces are restricted until they meet active points.

use super::coarse_level::CoarseLevel;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces};
use super::hierarchy::Hierarchy;
use super::quad::{Quad, ZERO, plus};
use super::solver::Solver;

impl CoarseLevel {
    /// Adds to the outer force of a point, restricted from outside the finer level's set.
    fn add_beyond(&mut self, point: u32, force: &Quad, weight: f32) {
        if self.beyond.insert(point) {
            self.far[point as usize] = ZERO;
        }
        let far = &mut self.far[point as usize];
        *far = plus(far, weight, force);
    }
}

impl Multigrid {
    /// Work of the outer forces along the correction, in N m: those restricted from nodes to level 1, and the deferred
    /// residual of each level. They are restricted once, until a force or a set changes.
    fn work_beyond(&mut self, structure: &Hierarchy) -> f64 {
        if !std::mem::replace(&mut self.is_beyond_restricted, true) {
            self.restrict_beyond(structure);
        }
        let mut sum = 0.0;
        for patch in &self.patches {
            for &point in &patch.beyond.items {
                let p = point as usize;
                if patch.inside[p] > 0 {
                    sum += work(&patch.far[p], &patch.e[p]);
                }
            }
        }
        sum
    }

    /// Restricts the outer forces to the active points.
    fn restrict_beyond(&mut self, structure: &Hierarchy) {
        for patch in &mut self.patches[1..] {
            patch.beyond.clear();
        }
        for l in 1..self.patches.len() {
            let (finer, coarser) = self.patches.split_at_mut(l);
            let (patch, above) = (&finer[l - 1], &mut coarser[0]);
            let mut restrict = |point: u32, force: &Quad| {
                let row = structure.levels[l - 1].prolongation.row(point as usize);
                row.for_each(|(coarse, weight)| above.add_beyond(coarse, force, weight));
            };
            let is_outside = |&&point: &&u32| patch.inside[point as usize] == 0;
            for &point in patch.beyond.items.iter().filter(is_outside) {
                restrict(point, &patch.far[point as usize]);
            }
            for &point in patch.lagging.items.iter().filter(is_outside) {
                restrict(point, &patch.lag[point as usize]);
            }
        }
    }
}

impl Solver {
    /// Work of all deferred and outer forces along the correction, at its start and its end, in N m. Needs the
    /// [restricted](Field::restrict_beyond) outer forces.
    pub(super) fn work_waiting(&mut self) -> [f64; 2] {
        let (structure, coarse) = (&self.structure, &mut self.coarse);
        let beyond = coarse.work_beyond(structure);
        coarse.work_along().map(|w| w + beyond)
    }
}

impl FineLevel {
    /// Unfixed nodes outside the set with a possibly nonzero force.
    pub(super) fn loud_beyond(&self) -> impl Iterator<Item = usize> {
        let beyond = |&&n: &&u32| !self.nodes.contains(n) && !self.fixed[n as usize];
        self.loud.items.iter().filter(beyond).map(|&n| n as usize)
    }

    /// Restricts the forces on nodes outside the set to level 1, if any has changed.
    pub(super) fn restrict_beyond(&mut self, structure: &Hierarchy, coarse: &mut Multigrid) {
        if std::mem::replace(&mut self.beyond, OuterForces::Restricted) == OuterForces::Restricted {
            return;
        }
        coarse.is_beyond_restricted = false;
        let patch = &mut coarse.patches[0];
        patch.beyond.clear();
        for n in self.loud_beyond() {
            for (point, weight) in structure.prolongation.row(n) {
                patch.add_beyond(point, &self.r[n], weight);
            }
        }
    }
}

fn work(force: &Quad, by: &Quad) -> f64 {
    (0..3).map(|a| f64::from(force[a]) * f64::from(by[a])).sum()
}
