//! Moves of the fine level's nodes: coarse corrections, smoothing and the warm start.

use super::coarse_level::apply;
use super::cycle::{Chebyshev, Multigrid};
use super::fine_level::{FineLevel, SetChange};
use super::hierarchy::Hierarchy;
use super::quad::{ZERO, plus};
use crate::Vec3;

/// Longest move of a node in one smoothing step, in spacings; longer ones are clamped and counted. Quick steps compute
/// the blocks once per iteration, and tissue that bottoms out hardens within the smoothing steps.
const MOVE_MAX: [f64; 2] = [0.5, 0.02];

impl FineLevel {
    /// Restricts the forces on the nodes of the set to level 1.
    pub(super) fn restrict(&mut self, hierarchy: &Hierarchy, coarse: &mut Multigrid) {
        let grid = &mut coarse.grids[0];
        for &node in &self.nodes.items {
            let n = node as usize;
            if self.fixed[n] {
                continue;
            }
            for (point, weight) in hierarchy.prolongation.row(n) {
                grid.load(point, &self.r[n], weight);
            }
        }
        // Disturbed nodes outside the set are restricted too: their forces are known.
        self.restrict_outer(hierarchy, coarse);
        let grid = &mut coarse.grids[0];
        for i in 0..grid.outer_points.items.len() {
            let point = grid.outer_points.items[i];
            let far = grid.outer_force[point as usize];
            grid.load(point, &far, 1.0);
        }
    }

    /// Whether a node is free, and was free throughout the last step. The move of a new node exceeds the increment of
    /// that step: it includes earlier displacements.
    fn is_settled(&self, node: u32) -> bool {
        let first = self.settled.items.is_empty();
        self.free[node as usize] && (first || self.settled.contains(node))
    }

    /// Starts a step: the increments of the set's nodes in the last step, in order of nodes. New nodes and nodes on the
    /// rim of the set use the increment of level 1, `e`, or deferred elements beside them would miss their moves.
    pub(super) fn take_increments(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        u: &[Vec3],
    ) -> Vec<(u32, Vec3)> {
        let mut increments = Vec::with_capacity(self.nodes.items.len());
        let e = &coarse.grids[0].e;
        for &node in &self.nodes.items {
            let n = node as usize;
            // A node that has just been held stays in place.
            if self.fixed[n] {
                continue;
            }
            if !self.is_settled(node) {
                let v = hierarchy.prolongation.interpolate(n, e);
                let by = Vec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]));
                increments.push((node, by));
            } else if self.moved_on.contains(node) {
                increments.push((node, u[n] - self.start[n]));
            }
        }
        self.moved_on.clear();
        self.settled.clear();
        for &node in &self.nodes.items {
            if self.free[node as usize] {
                self.settled.insert(node);
            }
        }
        increments
    }

    /// Moves nodes by `share` of these increments.
    pub(super) fn add_increments(
        &mut self,
        u: &mut [Vec3],
        increments: &[(u32, Vec3)],
        share: f64,
    ) {
        for &(node, by) in increments {
            self.shift(u, node, by * share);
        }
    }

    /// Moves nodes by `share` of these increments, which include those of level 1. The other nodes of the set follow
    /// level 1.
    pub(super) fn apply_increments(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        u: &mut [Vec3],
        increments: &[(u32, Vec3)],
        share: f64,
    ) {
        self.add_increments(u, increments, share);
        self.since = SetChange::Extrapolated;
        let mut moved = increments.iter().map(|m| m.0).peekable();
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            if moved.next_if_eq(&node).is_none() {
                self.follow_coarser(hierarchy, coarse, u, node);
            }
        }
    }

    /// Marks the nodes of the set as up to date with level 1, if that was postponed.
    pub(super) fn mark_applied(&mut self, hierarchy: &Hierarchy, coarse: &Multigrid) {
        if self.since == SetChange::Extrapolated {
            self.since = SetChange::Unchanged;
            for &node in &self.nodes.items {
                let total = &coarse.grids[0].total;
                let n = node as usize;
                self.applied[n] = hierarchy.prolongation.interpolate_exactly(n, total);
            }
        }
    }

    /// Whether every node moved in this step is finite and displaced by less than `limit` m.
    pub(super) fn is_within(&self, u: &[Vec3], limit: f64) -> bool {
        let within = |&node: &u32| u[node as usize].norm() < limit;
        self.moved_on.items.iter().all(within)
    }

    /// Restores every node moved in this step, and resets non-finite displacements to zero.
    pub(super) fn undo(&mut self, hierarchy: &Hierarchy, u: &mut [Vec3]) {
        for node in self.moved_on.take() {
            u[node as usize] = self.start[node as usize];
            self.disturb(hierarchy, node);
        }
        // Non-finite input has no earlier state.
        let lost = |u: &&mut Vec3| !u.norm().is_finite();
        u.iter_mut().filter(lost).for_each(|u| *u = Vec3::zeros());
        self.displaced = u.iter().map(Vec3::norm).fold(0.0, f64::max);
    }

    #[inline]
    pub(super) fn shift(&mut self, u: &mut [Vec3], node: u32, by: Vec3) {
        let n = node as usize;
        self.current = false;
        self.at_reference = false;
        if self.moved_on.insert(node) {
            self.start[n] = u[n];
        }
        u[n] += by;
        let square = u[n].norm_squared();
        if square > self.displaced * self.displaced {
            self.displaced = square.sqrt();
        }
    }

    /// Moves the nodes of the set by the correction of level 1.
    pub(super) fn correct(&mut self, hierarchy: &Hierarchy, coarse: &Multigrid, u: &mut [Vec3]) {
        self.moved.clear();
        self.old.clear();
        let e = &coarse.grids[0].e;
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            let n = node as usize;
            self.old.push(self.r[n]);
            let v = hierarchy.prolongation.interpolate(n, e);
            let by = Vec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]));
            let by = if self.fixed[n] { Vec3::zeros() } else { by };
            self.moved.push((node, by));
            self.shift(u, node, by);
        }
    }

    /// Reduces the applied correction to `share` of it; brick forces are interpolated linearly.
    pub(super) fn settle(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        u: &mut [Vec3],
        share: f64,
    ) {
        self.since = SetChange::Unchanged;
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            let n = node as usize;
            if share != 1.0 {
                self.shift(u, node, self.moved[i].1 * (share - 1.0));
                let change = plus(&self.r[n], -1.0, &self.old[i]);
                self.r[n] = plus(&self.old[i], share as f32, &change);
            }
            // The total of level 1 grew by the same amount.
            let total = &coarse.grids[0].total;
            self.applied[n] = hierarchy.prolongation.interpolate_exactly(n, total);
        }
    }

    /// One Chebyshev step over the free ones of these nodes, from the forces in `r`.
    pub(super) fn relax(&mut self, u: &mut [Vec3], nodes: &[u32], factors: &mut Chebyshev) {
        let (last, new) = factors.next();
        for &node in nodes {
            let n = node as usize;
            if !self.free[n] {
                continue;
            }
            let step = apply(&self.inverse[n], &self.r[n]);
            let before = if last == 0.0 { ZERO } else { self.d[n] };
            let d = plus(&step.map(|v| new * v), last, &before);
            self.d[n] = d;
            let mut by = Vec3::new(f64::from(d[0]), f64::from(d[1]), f64::from(d[2]));
            let length = by.norm();
            if !length.is_finite() {
                self.clamped += 1;
                self.d[n] = ZERO;
                continue;
            }
            if length > self.move_max {
                by *= self.move_max / length;
                self.clamped += 1;
            }
            self.shift(u, node, by);
        }
    }

    /// The same over the active set.
    pub(super) fn relax_set(&mut self, u: &mut [Vec3], factors: &mut Chebyshev) {
        let nodes = std::mem::take(&mut self.nodes.items);
        self.relax(u, &nodes, factors);
        self.nodes.items = nodes;
    }

    /// Sets the maximum move of a smoothing step; see [`MOVE_MAX`].
    pub(super) fn limit_moves(&mut self, hierarchy: &Hierarchy, near: bool) {
        let short = near && hierarchy.bottoms_out;
        self.move_max = MOVE_MAX[usize::from(short)] / f64::from(hierarchy.per_spacing);
    }
}
