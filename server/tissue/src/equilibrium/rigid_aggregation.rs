//! Line search along an increment, with rigid aggregation of the stiffest bricks.
//!
//! The warm start extrapolates along a straight line. Tissue pressed nearly flat is hundreds of times stiffer than at
//! rest: a small strain there dominates the work along the increment, so that the line search accepts a hundredth of it.
//! If it accepts less than half of its bound, the bricks that resist most are aggregated into rigid groups. Connected bricks
//! move by the mean of their free nodes, or not at all if one of their nodes is held; the smoother corrects the rest. (The
//! seed's rigid clusters, Lin 2007, section 3.5, applied to displacements instead of forces.)

use std::collections::BTreeMap;

use super::brick::LOCALS;
use super::fine_level::FineLevel;
use super::hierarchy::Hierarchy;
use super::mechanism::Mechanism;
use super::quad::{Quad, ZERO, work};
use super::solver::Solver;
use crate::Vec3;
use crate::contact::LineSearch;

/// Step length, relative to its upper bound, below which resisting bricks are aggregated.
const AGGREGATE_BELOW: f64 = 0.5;
/// Work of a brick against the increment, relative to the total work, from which on it is aggregated.
const RESISTING_WORK: f64 = 0.03;

impl Solver {
    /// The step length of [`Self::line_search`], after the bricks that resist it have been aggregated.
    pub(super) fn line_search_with_rigid_groups(
        &mut self,
        u: &mut [Vec3],
        increments: &mut [(u32, Vec3)],
        before: &[Quad],
        deferred: [f64; 2],
        bounds: [f64; 2],
    ) -> f64 {
        let (share, gain) = self.line_search(u, increments, before, deferred, bounds);
        let short = share < AGGREGATE_BELOW * bounds[1] && gain > 0.0;
        // Once: aggregating again after the second search brought no gain.
        let aggregated = short && self.uses(Mechanism::RigidAggregation) && {
            let most = RESISTING_WORK * gain;
            self.fine.aggregate(&self.hierarchy, u, increments, most)
        };
        if !aggregated {
            return share;
        }
        self.line_search(u, increments, before, deferred, bounds).0
    }

    /// Line search: the step length within bounds at which the work along these increments vanishes, and the work along
    /// them at their start in N m. `increments` are sorted by node, and shape and forces are at their end. `before` are the
    /// brick forces at their start in N;
    /// `deferred` is the work of deferred forces at both ends in N m.
    pub(super) fn line_search(
        &self,
        u: &[Vec3],
        increments: &[(u32, Vec3)],
        before: &[Quad],
        deferred: [f64; 2],
        bounds: [f64; 2],
    ) -> (f64, f64) {
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
        if !self.uses(Mechanism::ContactLineSearch) {
            let contacts = [0.0, 1.0].map(|s| along.work(s));
            let work = [here + contacts[0], there + contacts[1]];
            let none = LineSearch::new(Vec::new(), Vec::new());
            return (none.zero_work(work, bounds), work[0]);
        }
        (
            along.zero_work([here, there], bounds),
            here + along.work(0.0),
        )
    }
}

/// Work along increments in N m; `of` returns the force by position and node.
fn work_along<'a>(increments: &[(u32, Vec3)], of: impl Fn(usize, u32) -> &'a Quad) -> f64 {
    let all = increments.iter().enumerate();
    all.map(|(i, (node, by))| work(of(i, *node), by)).sum()
}

impl FineLevel {
    /// Aggregates bricks whose work against these increments exceeds `most` N m. The shape is at the end of the
    /// increments; the saved forces belong to their start. Returns whether any increment changed.
    fn aggregate(
        &mut self,
        hierarchy: &Hierarchy,
        u: &mut [Vec3],
        increments: &mut [(u32, Vec3)],
        most: f64,
    ) -> bool {
        let mut changed = Vec::new();
        for nodes in connected_groups(hierarchy, &self.resisting(hierarchy, increments, most)) {
            let places: Vec<usize> = nodes
                .iter()
                .filter(|&&n| self.free[n as usize])
                .filter_map(|n| increments.binary_search_by_key(n, |m| m.0).ok())
                .collect();
            let held = nodes.iter().any(|&n| self.fixed[n as usize]);
            let sum: Vec3 = places.iter().map(|&i| increments[i].1).sum();
            let mean = if held {
                Vec3::zeros()
            } else {
                sum / places.len().max(1) as f64
            };
            for i in places {
                let (node, by) = increments[i];
                if by != mean {
                    self.shift(u, node, mean - by);
                    increments[i].1 = mean;
                    changed.push(node);
                }
            }
        }
        self.left.clear();
        for &node in &changed {
            for &entry in hierarchy.around.row(node) {
                self.left.insert(entry / 32);
            }
        }
        let bricks = self.left.take();
        self.compute(hierarchy, u, &bricks);
        for &brick in &bricks {
            for &node in &hierarchy.bricks[brick as usize].nodes {
                self.r[node as usize] = self.sum(hierarchy, node);
            }
        }
        !changed.is_empty()
    }

    /// Active bricks that do more than `most` N m against the increments.
    fn resisting(
        &mut self,
        hierarchy: &Hierarchy,
        increments: &[(u32, Vec3)],
        most: f64,
    ) -> Vec<u32> {
        // Smoothing starts without a previous step, so `d` is free for the increments.
        for &node in &self.nodes.items {
            self.d[node as usize] = ZERO;
        }
        for (node, by) in increments {
            self.d[*node as usize] = [by.x as f32, by.y as f32, by.z as f32, 0.0];
        }
        let resists = |(&brick, before): (&u32, &[[f32; LOCALS]; 3])| {
            let nodes = &hierarchy.bricks[brick as usize].nodes;
            let now = &self.forces[brick as usize];
            let mut work = [0.0f32; LOCALS];
            for (l, work) in work.iter_mut().enumerate() {
                let by = &self.d[nodes[l] as usize];
                for a in 0..3 {
                    *work += (before[a][l] - now[a][l]) * by[a];
                }
            }
            (f64::from(work.iter().sum::<f32>()) > most).then_some(brick)
        };
        let bricks = self.set.items.iter().zip(&self.kept);
        bricks.filter_map(resists).collect()
    }
}

/// Nodes of bricks that share nodes, group by group.
fn connected_groups(hierarchy: &Hierarchy, bricks: &[u32]) -> Vec<Vec<u32>> {
    let mut groups: Vec<Vec<u32>> = Vec::new();
    let mut group_of: BTreeMap<u32, usize> = BTreeMap::new();
    for (own, &brick) in bricks.iter().enumerate() {
        groups.push(Vec::new());
        let b = &hierarchy.bricks[brick as usize];
        for l in (0..LOCALS).filter(|l| b.present >> l & 1 == 1) {
            let node = b.nodes[l];
            match group_of.insert(node, own) {
                None => groups[own].push(node),
                Some(other) if other != own => {
                    let others = std::mem::take(&mut groups[other]);
                    for &n in &others {
                        group_of.insert(n, own);
                    }
                    groups[own].extend(others);
                }
                Some(_) => {}
            }
        }
    }
    groups
}
