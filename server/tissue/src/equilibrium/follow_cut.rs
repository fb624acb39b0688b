//! How a solver follows a cut: the change of its levels, and its state around it.
//!
//! Before the levels change, the deferred part of the state around the cut is resolved: pending displacements of the
//! elements that change go to their children, at last as outdated forces of bricks, and the nodes and points there receive
//! the displacements of the coarser levels. Afterwards new points and nodes copy those that they were split from. The state
//! elsewhere stays, so no force far from the cut changes.
//!
//! An undo removes nodes and points. Nodes and points around then follow other points of the coarser levels, so the
//! displacements of these count as received: no remaining node moves.

use super::coarse_level::{CoarseLevel, List, NONE, invert, update_total};
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces, SetChange};
use super::hierarchy::{Hierarchy, Level};
use super::hierarchy_change::{HierarchyChange, LevelChange};
use super::quad::{ZERO, plus, trim};
use super::solver::Solver;
use super::weight::weight_of;
use crate::contact::SurfaceTree;
use crate::{Shape, Topology, Vec3};

impl Solver {
    /// Follows a change that made `topology`: a cut, an undo, a redo or a reset. A tree of its surface is exchanged for the
    /// present one.
    pub(super) fn follow(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
        change: &HierarchyChange,
        tree: Option<&mut SurfaceTree>,
    ) {
        let spacing = topology.model().spacing_m;
        self.contacts
            .augment(&shape.displacement, &self.fine.fixed, spacing);
        self.forget_removed(change.stays);
        let (fine, coarse) = (&mut self.fine, &mut self.coarse);
        let is_return = change.keeps.nodes < self.hierarchy.prolongation.len();
        if is_return {
            // Samples refer to nodes that may be gone.
            fine.remove_contacts(&self.hierarchy, &self.contacts.nodes);
            self.contacts.forget();
        }
        fine.mark_applied(&self.hierarchy, coarse);
        coarse.clear_stiffness(&self.hierarchy);
        coarse.release_pending(&self.hierarchy, change, fine);
        let u = &mut shape.displacement;
        let current = fine.bring_up_to_date(&self.hierarchy, coarse, change, u);
        trim(u, change.stays);
        for outcome in &change.outcomes {
            shape.follow(topology, outcome);
        }
        self.hierarchy.apply(change);
        for (l, grid) in coarse.grids.iter_mut().enumerate() {
            let keeps = &change.keeps.levels[l];
            grid.shrink(keeps.elements, keeps.points);
            grid.follow(&self.hierarchy, l, &change.levels[l]);
        }
        coarse.is_outer_restricted = false;
        fine.follow(topology, &self.hierarchy, change);
        fine.receive_at_parted(&self.hierarchy, coarse, change);
        if is_return {
            fine.rebase(&self.hierarchy, coarse, change, &current);
        }
        let moved = change.outcomes.iter().flat_map(|o| &o.moved);
        for node in moved.map(|m| m.node) {
            fine.displaced = fine.displaced.max(shape.displacement[node as usize].norm());
        }
        self.contact_smoother.follow(&self.hierarchy);
        self.contacts
            .follow(topology, change.stays, &change.surface, tree);
        self.report.steady = false;
        self.dirty = true;
    }

    /// Releases held nodes from this number on.
    pub(super) fn forget_removed(&mut self, nodes: usize) {
        self.held.retain(|&n| (n as usize) < nodes);
        self.prescribed_from.retain(|&n, _| (n as usize) < nodes);
    }
}

/// Nodes, and points of each level, that are up to date with the coarser levels.
struct Current {
    nodes: Vec<u32>,
    points: Vec<Vec<u32>>,
}

impl Multigrid {
    /// Passes the pending displacements of changing elements on to their children.
    fn release_pending(
        &mut self,
        hierarchy: &Hierarchy,
        change: &HierarchyChange,
        fine: &mut FineLevel,
    ) {
        for (l, level) in hierarchy.levels.iter().enumerate().rev() {
            for element in change.changed_or_removed(l, level) {
                if self.grids[l].has_pending[element as usize] {
                    self.release(hierarchy, l, element, f32::INFINITY);
                    if l == 0 {
                        for &brick in level.children.row(element) {
                            fine.stale.insert(brick);
                        }
                    }
                }
            }
            self.grids[l].trim();
        }
    }
}

impl FineLevel {
    /// Brings all nodes of changed, removed and outdated bricks up to date with the coarse levels. Returns them with the
    /// points that are then up to date.
    fn bring_up_to_date(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &mut Multigrid,
        change: &HierarchyChange,
        u: &mut [Vec3],
    ) -> Current {
        let changed = change.bricks.iter().map(|b| b.0);
        let gone = change.keeps.bricks as u32..hierarchy.bricks.len() as u32;
        let is_return = change.keeps.nodes < hierarchy.prolongation.len();
        let bricks = changed.chain(gone).chain(self.stale.items.iter().copied());
        for brick in bricks.filter_map(|b| hierarchy.bricks.get(b as usize)) {
            for node in brick.nodes {
                self.touched.insert(node);
            }
        }
        if is_return {
            // Operators of more nodes and points change than those of a cut.
            let first = &hierarchy.levels[0];
            let of_changed = change.changed_or_removed(0, first);
            let known = |n: &u32| (*n as usize) < hierarchy.prolongation.len();
            let entries = change.levels[0].entries.keys().copied().filter(known);
            let of_changed = of_changed.into_iter();
            let rows = of_changed.flat_map(|e| hierarchy.nodes_of.row(e).iter().copied());
            for node in rows.chain(entries) {
                self.touched.insert(node);
            }
        }
        let nodes = self.touched.take();
        // The corners of all elements that these nodes, or points of the finer level, follow.
        let of_node = |&n: &u32| hierarchy.prolongation.element_of(n as usize);
        let mut elements: Vec<u32> = nodes.iter().filter_map(of_node).collect();
        let mut of_levels = Vec::new();
        for (l, level) in hierarchy.levels.iter().enumerate() {
            elements.extend(change.changed_or_removed(l, level));
            let mut entries = Vec::new();
            if let Some(above) = hierarchy.levels.get(l + 1).filter(|_| is_return) {
                for parent in change.changed_or_removed(l + 1, above) {
                    elements.extend_from_slice(above.children.row(parent));
                }
                let known = |p: &u32| (*p as usize) < level.points();
                entries.extend(change.levels[l + 1].entries.keys().copied().filter(known));
            }
            let points = points_of(level, elements, entries);
            let above = points.iter().filter_map(|&p| level.element_above(p));
            elements = above.collect();
            of_levels.push(points);
        }
        for l in (0..of_levels.len().saturating_sub(1)).rev() {
            let (finer, coarser) = coarse.grids.split_at_mut(l + 1);
            let (grid, above) = (&mut finer[l], &coarser[0]);
            for &point in &of_levels[l] {
                let p = point as usize;
                let prolongation = &hierarchy.levels[l].prolongation;
                let now = prolongation.interpolate_exactly(p, &above.total);
                update_total(now, &mut grid.total[p], &mut grid.applied[p]);
            }
        }
        for &node in &nodes {
            self.follow_coarser(hierarchy, coarse, u, node);
        }
        Current {
            nodes,
            points: of_levels,
        }
    }

    /// Counts the displacements of the coarser levels as received at nodes that were parted from pinned ones, which
    /// follow no element: so no such node jumps.
    fn receive_at_parted(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        change: &HierarchyChange,
    ) {
        let doubled = change.outcomes.iter().flat_map(|o| &o.doubled);
        for &(new, from) in doubled {
            if self.fixed[from as usize] {
                let n = new as usize;
                let total = &coarse.grids[0].total;
                self.applied[n] = hierarchy.prolongation.interpolate_exactly(n, total);
            }
        }
    }

    /// After a return: counts the displacements of the coarser levels as received, with the operators as they are now, at the
    /// nodes and points that were up to date before and at new ones.
    fn rebase(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &mut Multigrid,
        change: &HierarchyChange,
        current: &Current,
    ) {
        let of = |list: &[u32], keeps: usize, count: usize| -> Vec<u32> {
            let kept = list.iter().copied().filter(|n| (*n as usize) < keeps);
            kept.chain(keeps as u32..count as u32).collect()
        };
        let total = &coarse.grids[0].total;
        for node in of(&current.nodes, change.keeps.nodes, self.applied.len()) {
            let n = node as usize;
            self.applied[n] = hierarchy.prolongation.interpolate_exactly(n, total);
        }
        for l in 0..current.points.len().saturating_sub(1) {
            let (finer, coarser) = coarse.grids.split_at_mut(l + 1);
            let (grid, above) = (&mut finer[l], &coarser[0]);
            let keeps = change.keeps.levels[l].points;
            for point in of(&current.points[l], keeps, grid.applied.len()) {
                let p = point as usize;
                let prolongation = &hierarchy.levels[l].prolongation;
                grid.applied[p] = prolongation.interpolate_exactly(p, &above.total);
            }
        }
    }

    fn node_lists(&mut self) -> [&mut List; 7] {
        [
            &mut self.nodes,
            &mut self.unbalanced,
            &mut self.below_threshold,
            &mut self.disturbed,
            &mut self.touched,
            &mut self.moved_on,
            &mut self.settled,
        ]
    }

    fn brick_lists(&mut self) -> [&mut List; 4] {
        [
            &mut self.set,
            &mut self.left,
            &mut self.stale,
            &mut self.computed,
        ]
    }

    /// Drops nodes and bricks that a change removes.
    fn shrink(&mut self, change: &HierarchyChange) {
        let (nodes, bricks) = (change.keeps.nodes, change.keeps.bricks);
        if nodes >= self.applied.len() {
            return;
        }
        // The next step fills them again.
        (self.kept, self.moved, self.old) = Default::default();
        self.pressed = Vec::new();
        trim(&mut self.applied, nodes);
        trim(&mut self.fixed, nodes);
        trim(&mut self.own, nodes);
        trim(&mut self.weights, change.stays);
        trim(&mut self.r, nodes);
        trim(&mut self.d, nodes);
        trim(&mut self.inverse, nodes);
        trim(&mut self.blocks, nodes);
        trim(&mut self.start, nodes);
        trim(&mut self.inside, nodes);
        trim(&mut self.free, nodes);
        trim(&mut self.forces, bricks);
        trim(&mut self.block_sum, bricks);
        trim(&mut self.block_sum_at_rest, change.keeps.forms);
        trim(&mut self.blocks_at_rest, change.keeps.forms);
        for list in self.node_lists() {
            list.shrink(nodes);
        }
        for list in self.brick_lists() {
            list.shrink(bricks);
        }
        self.required.shrink(change.keeps.levels[0].elements);
    }

    /// Follows a change of weights: without a new component a node hangs if its origin does.
    fn follow_weights(&mut self, topology: &Topology, change: &HierarchyChange) {
        if self.weights.is_empty() {
            return;
        }
        if let Some(weights) = &change.weights {
            self.weights.clone_from(weights);
            return;
        }
        for (_, from) in change.outcomes.iter().flat_map(|o| &o.doubled) {
            self.weights.push(self.weights[*from as usize]);
        }
        for &(node, _) in &change.own {
            let weight = &mut self.weights[node as usize];
            if *weight != ZERO {
                *weight = weight_of(topology, node);
            }
        }
    }

    /// Follows a change of the levels: new nodes and bricks, outdated forces of changed bricks, and an empty active set.
    fn follow(&mut self, topology: &Topology, hierarchy: &Hierarchy, change: &HierarchyChange) {
        let (nodes, bricks) = (topology.node_count(), hierarchy.bricks.len());
        for &node in &self.nodes.items {
            self.inside[node as usize] = 0;
            self.free[node as usize] = false;
            self.unbalanced.insert(node);
        }
        self.nodes.clear();
        self.set.clear();
        self.left.clear();
        self.shrink(change);
        let new = self.fixed.len() as u32..nodes as u32;
        self.fixed.extend(new.map(|n| topology.is_pinned(n)));
        self.applied.resize(nodes, [0.0; 3]);
        for &(new, from) in change.outcomes.iter().flat_map(|o| &o.doubled) {
            self.applied[new as usize] = self.applied[from as usize];
        }
        self.own.resize(nodes, 0.0);
        for &(node, stiffness) in &change.own {
            self.own[node as usize] = stiffness;
        }
        self.follow_weights(topology, change);
        self.r.resize(nodes, ZERO);
        self.d.resize(nodes, ZERO);
        self.inverse.resize(nodes, [0.0; 6]);
        self.blocks.resize(nodes, [0.0; 6]);
        self.start.resize(nodes, Vec3::zeros());
        self.inside.resize(nodes, 0);
        self.free.resize(nodes, false);
        self.forces.resize(bricks, Default::default());
        self.block_sum.resize(bricks, [0.0; 6]);
        self.block_sum_at_rest.resize(hierarchy.forms.len(), None);
        self.blocks_at_rest.resize(hierarchy.forms.len(), None);
        for (form, _) in &change.forms {
            self.block_sum_at_rest[*form as usize] = None;
            self.blocks_at_rest[*form as usize] = None;
        }
        for list in self.node_lists() {
            list.grow(nodes);
        }
        for list in self.brick_lists() {
            list.grow(bricks);
        }
        self.required.grow(hierarchy.levels[0].corners.len());
        for &(brick, ..) in &change.bricks {
            self.stale.insert(brick);
            self.block_sum[brick as usize] = [0.0; 6];
        }
        self.since = SetChange::Replaced;
        self.outer_forces = OuterForces::Changed;
        self.outdated = true;
        self.current = false;
    }
}

impl CoarseLevel {
    /// Follows a change of its level: new elements and points, and an empty active set.
    fn follow(&mut self, hierarchy: &Hierarchy, l: usize, change: &LevelChange) {
        let level = &hierarchy.levels[l];
        let (elements, points) = (level.corners.len(), level.points());
        for &point in &self.points.items {
            self.inside[point as usize] = 0;
            self.free[point as usize] = false;
        }
        for list in [&mut self.set, &mut self.refined, &mut self.points] {
            list.clear();
        }
        for &from in &change.origins {
            let from = from as usize;
            self.total.push(self.total[from]);
            self.applied.push(self.applied[from]);
            self.step_correction.push(self.step_correction[from]);
        }
        for vectors in [
            &mut self.e,
            &mut self.d,
            &mut self.b,
            &mut self.r,
            &mut self.outer_force,
            &mut self.deferred_residual,
        ] {
            vectors.resize(points, ZERO);
        }
        self.inside.resize(points, 0);
        self.free.resize(points, false);
        self.added_bound.resize(points, [0.0; 6]);
        self.inverse.resize(points, [0.0; 6]);
        for (point, bound) in &change.bounds {
            self.inverse[*point as usize] = invert(bound);
        }
        self.stiffness_of.resize(elements, NONE);
        self.grow_pending(elements);
        for element in change.elements() {
            self.secant[element as usize] = 1.0;
        }
        for list in self.element_lists() {
            list.grow(elements);
        }
        for list in self.point_lists() {
            list.grow(points);
        }
        for point in change.points() {
            let mut residual = ZERO;
            for &e in level.around.row(point) {
                let corners = level.corners[e as usize].iter();
                for (_, force) in corners
                    .zip(&self.deferred_force[e as usize])
                    .filter(|c| *c.0 == point)
                {
                    residual = plus(&residual, -1.0, force);
                }
            }
            self.deferred_residual[point as usize] = residual;
            self.deferred_points.insert(point);
        }
        self.trim();
    }
}

/// The points of these elements, and further ones, sorted.
fn points_of(level: &Level, mut elements: Vec<u32>, further: Vec<u32>) -> Vec<u32> {
    elements.sort_unstable();
    elements.dedup();
    let known = elements
        .iter()
        .filter_map(|&e| level.corners.get(e as usize));
    let mut points: Vec<u32> = known.flatten().copied().chain(further).collect();
    points.sort_unstable();
    points.dedup();
    points
}

#[cfg(test)]
mod tests;
