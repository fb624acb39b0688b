//! What a correction does beyond the part of a level that takes part in it.
//!
//! Forces out there are handed to the levels like all others, and moved along by what they answer. To tell
//! how much of an answer to take without the work of those forces would weigh its price against half of its
//! gain.

use super::block::{Quad, ZERO, plus};
use super::cycle::Multigrid;
use super::field::Field;
use super::solver::Solver;
use super::structure::Structure;

impl Multigrid {
    /// The correction at a point of level `l`, also of one that only follows the coarser levels. What was found
    /// stays known until [`forget`](Self::forget).
    pub(super) fn correction(&mut self, structure: &Structure, l: usize, point: u32) -> Quad {
        let p = point as usize;
        let patch = &mut self.patches[l];
        if patch.inside[p] > 0 || !patch.followed.insert(point) {
            return patch.e[p];
        }
        let mut e = ZERO;
        if l + 1 < self.patches.len() {
            let ties = &structure.levels[l].ties[p];
            for t in 0..ties.len as usize {
                let above = self.correction(structure, l + 1, ties.to[t]);
                e = plus(&e, ties.weight[t], &above);
            }
        }
        self.patches[l].e[p] = e;
        e
    }

    /// Forgets what points beyond the sets follow: there is a new correction.
    pub(super) fn forget(&mut self) {
        for patch in &mut self.patches {
            patch.followed.clear();
        }
    }

    /// Work of the lag beyond the sets along the correction, in N m.
    pub(super) fn work_of_lag_beyond(&mut self, structure: &Structure) -> f64 {
        let mut sum = 0.0;
        for l in 0..self.patches.len() {
            for i in 0..self.patches[l].lagging.items.len() {
                let point = self.patches[l].lagging.items[i];
                if self.patches[l].inside[point as usize] == 0 {
                    let e = self.correction(structure, l, point);
                    sum += work(&self.patches[l].lag[point as usize], &e);
                }
            }
        }
        sum
    }
}

impl Solver {
    /// Work of what waits along the correction that has been deferred, before it and after it, in N m.
    pub(super) fn work_waiting(&mut self) -> [f64; 2] {
        let (structure, coarse) = (&self.structure, &mut self.coarse);
        let beyond = self.field.work_beyond(structure, coarse);
        coarse.work_along(structure).map(|w| w + beyond)
    }
}

impl Field {
    /// Nodes beyond the set that may move and on which forces are known that may not be zero.
    pub(super) fn loud_beyond(&self) -> impl Iterator<Item = usize> {
        let beyond = |&&n: &&u32| !self.nodes.contains(n) && !self.fixed[n as usize];
        self.loud.items.iter().filter(beyond).map(|&n| n as usize)
    }

    /// Work of the known forces on nodes beyond the set along the correction, in N m.
    fn work_beyond(&self, structure: &Structure, coarse: &mut Multigrid) -> f64 {
        let mut sum = 0.0;
        for n in self.loud_beyond() {
            let ties = &structure.ties[n];
            for t in 0..ties.len as usize {
                let e = coarse.correction(structure, 0, ties.to[t]);
                sum += f64::from(ties.weight[t]) * work(&self.r[n], &e);
            }
        }
        sum
    }
}

fn work(force: &Quad, by: &Quad) -> f64 {
    (0..3).map(|a| f64::from(force[a]) * f64::from(by[a])).sum()
}
