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
    fn add_outer(&mut self, point: u32, force: &Quad, weight: f32) {
        if self.outer_points.insert(point) {
            self.outer_force[point as usize] = ZERO;
        }
        let far = &mut self.outer_force[point as usize];
        *far = plus(far, weight, force);
    }
}

impl Multigrid {
    /// Work of the outer forces along the correction, in N m: those restricted from nodes to level 1, and the deferred
    /// residual of each level. They are restricted once, until a force or a set changes.
    fn work_outer(&mut self, hierarchy: &Hierarchy) -> f64 {
        if !std::mem::replace(&mut self.is_outer_restricted, true) {
            self.restrict_outer(hierarchy);
        }
        let mut sum = 0.0;
        for grid in &self.grids {
            for &point in &grid.outer_points.items {
                let p = point as usize;
                if grid.inside[p] > 0 {
                    sum += work(&grid.outer_force[p], &grid.e[p]);
                }
            }
        }
        sum
    }

    /// Restricts the outer forces to the active points.
    fn restrict_outer(&mut self, hierarchy: &Hierarchy) {
        for grid in &mut self.grids[1..] {
            grid.outer_points.clear();
        }
        for l in 1..self.grids.len() {
            let (finer, coarser) = self.grids.split_at_mut(l);
            let (grid, above) = (&finer[l - 1], &mut coarser[0]);
            let mut restrict = |point: u32, force: &Quad| {
                let row = hierarchy.levels[l - 1].prolongation.row(point as usize);
                row.for_each(|(coarse, weight)| above.add_outer(coarse, force, weight));
            };
            let is_outside = |&&point: &&u32| grid.inside[point as usize] == 0;
            for &point in grid.outer_points.items.iter().filter(is_outside) {
                restrict(point, &grid.outer_force[point as usize]);
            }
            for &point in grid.deferred_points.items.iter().filter(is_outside) {
                restrict(point, &grid.deferred_residual[point as usize]);
            }
        }
    }
}

impl Solver {
    /// Work of all deferred and outer forces along the correction, at its start and its end, in N m. Needs the
    /// [restricted](FineLevel::restrict_outer) outer forces.
    pub(super) fn deferred_work(&mut self) -> [f64; 2] {
        let (hierarchy, coarse) = (&self.hierarchy, &mut self.coarse);
        let outer = coarse.work_outer(hierarchy);
        coarse.work_along().map(|w| w + outer)
    }
}

impl FineLevel {
    /// Unfixed nodes outside the set with a possibly nonzero force.
    pub(super) fn unbalanced_outer(&self) -> impl Iterator<Item = usize> {
        let outer = |&&n: &&u32| !self.nodes.contains(n) && !self.fixed[n as usize];
        self.unbalanced
            .items
            .iter()
            .filter(outer)
            .map(|&n| n as usize)
    }

    /// Restricts the forces on nodes outside the set to level 1, if any has changed.
    pub(super) fn restrict_outer(&mut self, hierarchy: &Hierarchy, coarse: &mut Multigrid) {
        if std::mem::replace(&mut self.outer_forces, OuterForces::Restricted)
            == OuterForces::Restricted
        {
            return;
        }
        coarse.is_outer_restricted = false;
        let grid = &mut coarse.grids[0];
        grid.outer_points.clear();
        for n in self.unbalanced_outer() {
            for (point, weight) in hierarchy.prolongation.row(n) {
                grid.add_outer(point, &self.r[n], weight);
            }
        }
    }
}

fn work(force: &Quad, by: &Quad) -> f64 {
    (0..3).map(|a| f64::from(force[a]) * f64::from(by[a])).sum()
}
