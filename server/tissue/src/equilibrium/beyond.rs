//! What a correction does beyond the part of a level that takes part in it.
//!
//! Forces out there are handed to the levels like all others, and moved along by what they answer. To tell
//! how much of an answer to take without the work of those forces would weigh its price against half of its
//! gain.
//!
//! A point beyond the set of its level follows the coarser one by its weights, e = P e', so that the work of a force f
//! on it is that of Pᵀ f on the coarser level's points: f · P e' = Pᵀ f · e'. Forces are restricted until they meet
//! points that take part.

use super::block::{Quad, ZERO, plus};
use super::cycle::Multigrid;
use super::field::{Beyond, Field};
use super::patch::Patch;
use super::solver::Solver;
use super::structure::Structure;

impl Patch {
    /// Adds to the force on a point that was restricted from beyond the set of the finer level.
    fn add_beyond(&mut self, point: u32, force: &Quad, weight: f32) {
        if self.beyond.insert(point) {
            self.far[point as usize] = ZERO;
        }
        let far = &mut self.far[point as usize];
        *far = plus(far, weight, force);
    }
}

impl Multigrid {
    /// Work of the forces beyond the sets along the correction, in N m: those restricted from nodes to level 1, and
    /// the lag of each level. They are restricted once until one of them, or the set of a level, changes.
    fn work_beyond(&mut self, structure: &Structure) -> f64 {
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

    /// Restricts the forces on points beyond the sets to the points that take part.
    fn restrict_beyond(&mut self, structure: &Structure) {
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
    /// Work of what waits along the correction that has been deferred, before it and after it, in N m. Wants the
    /// forces beyond the set [restricted](Field::restrict_beyond).
    pub(super) fn work_waiting(&mut self) -> [f64; 2] {
        let (structure, coarse) = (&self.structure, &mut self.coarse);
        let beyond = coarse.work_beyond(structure);
        coarse.work_along().map(|w| w + beyond)
    }
}

impl Field {
    /// Nodes beyond the set that may move and on which forces are known that may not be zero.
    pub(super) fn loud_beyond(&self) -> impl Iterator<Item = usize> {
        let beyond = |&&n: &&u32| !self.nodes.contains(n) && !self.fixed[n as usize];
        self.loud.items.iter().filter(beyond).map(|&n| n as usize)
    }

    /// Restricts the known forces on nodes beyond the set to the points of level 1, if they are not the same as before.
    pub(super) fn restrict_beyond(&mut self, structure: &Structure, coarse: &mut Multigrid) {
        if std::mem::replace(&mut self.beyond, Beyond::Restricted) == Beyond::Restricted {
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
