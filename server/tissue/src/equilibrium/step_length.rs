//! Line search: the step length along an increment of the displacements.

use super::mechanism::Mechanism;
use super::quad::{Quad, work};
use super::solver::Solver;
use crate::Vec3;
use crate::contact::LineSearch;

impl Solver {
    /// The step length within bounds at which the work along these increments vanishes. `increments` are sorted by node,
    /// and shape and forces are at their end. `before` are the brick forces at their start in N; `deferred` is the work of
    /// deferred forces at both ends in N m.
    pub(super) fn line_search(
        &self,
        u: &[Vec3],
        increments: &[(u32, Vec3)],
        before: &[Quad],
        deferred: [f64; 2],
        bounds: [f64; 2],
    ) -> f64 {
        let by = |n: u32| {
            let found = increments.binary_search_by_key(&n, |m| m.0);
            found.map_or_else(|_| Vec3::zeros(), |i| increments[i].1)
        };
        let mut along = self.contacts.line_search(u, by, 1.0);
        if !self.uses(Mechanism::CoreGuard) {
            along.ignore_cores();
        }
        let here = deferred[0] + work_along(increments, |i, _| &before[i]);
        let r = &self.fine.r;
        let there = deferred[1] + work_along(increments, |_, node| &r[node as usize]);
        if self.uses(Mechanism::ContactLineSearch) {
            return along.zero_work([here, there], bounds);
        }
        let work = [here + along.work(0.0), there + along.work(1.0)];
        LineSearch::new(Vec::new(), Vec::new()).zero_work(work, bounds)
    }
}

/// Work along increments in N m; `of` returns the force by position and node.
fn work_along<'a>(increments: &[(u32, Vec3)], of: impl Fn(usize, u32) -> &'a Quad) -> f64 {
    let all = increments.iter().enumerate();
    all.map(|(i, (node, by))| work(of(i, *node), by)).sum()
}
