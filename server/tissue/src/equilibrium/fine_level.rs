//! The fine level: forces of bricks on nodes, and the active set.
//!
//! Every brick caches its last forces; the force on a node is the sum over the bricks around it. A step recomputes the
//! bricks of the refined elements of level 1. A node is free if all its bricks are active; nodes on the rim follow
//! level 1.

use pulp::Arch;
use rayon::prelude::*;

use super::brick::LOCALS;
use super::coarse_level::List;
use super::cycle::Multigrid;
use super::hierarchy::Hierarchy;
use super::jacobi_blocks::JacobiBlocks;
use super::kernel::{Ends, Forces};
use super::mechanism::Disabled;
use super::quad::{Quad, ZERO, laid_out, square};
use super::weight::weights;
use crate::contact::Contacts;
use crate::{Topology, Vec3};

/// Bricks from which on they are shared among threads.
const PARALLEL: usize = 512;

/// State of the active set since the last warm start or coarse correction.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum SetChange {
    /// Unchanged; the nodes are still to be marked as up to date with level 1.
    Extrapolated,
    /// Unchanged.
    Unchanged,
    /// Replaced by a new choice.
    Replaced,
}

/// State of the forces on nodes outside the active set.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum OuterForces {
    /// Not yet restricted to level 1.
    Changed,
    /// Restricted, and unchanged since.
    Restricted,
}

/// State of nodes and bricks.
pub(super) struct FineLevel {
    /// Pinned or held.
    pub(super) fixed: Vec<bool>,
    /// Mean stiffness of the node at rest in N/m.
    pub(super) own: Vec<f64>,
    /// Weight of each node in N; empty without gravity.
    pub(super) weights: Vec<Quad>,
    /// Last computed forces of each brick on its nodes.
    pub(super) forces: Vec<[[f32; LOCALS]; 3]>,
    /// Bricks computed since the tissue was at rest.
    pub(super) computed: List,
    /// Saved forces of the active bricks; scratch.
    pub(super) kept: Vec<[[f32; LOCALS]; 3]>,
    /// Force on each node in N, including contacts where they were evaluated.
    pub(super) r: Vec<Quad>,
    pub(super) inverse: Vec<[f32; 6]>,
    pub(super) d: Vec<Quad>,
    /// Displacement of level 1 that each node has already received.
    pub(super) applied: Vec<[f64; 3]>,
    /// Active bricks and their nodes.
    pub(super) set: List,
    /// The previous set; scratch.
    pub(super) left: List,
    pub(super) nodes: List,
    pub(super) inside: Vec<u32>,
    pub(super) free: Vec<bool>,
    /// Nodes with a possibly nonzero force.
    pub(super) unbalanced: List,
    /// Nodes below the threshold of quick steps; full solves reconsider them.
    pub(super) below_threshold: List,
    /// Nodes that are not free and were disturbed since the last choice of the set.
    pub(super) disturbed: List,
    /// State of the forces on nodes outside the set.
    pub(super) outer_forces: OuterForces,
    /// Elements of level 1 to be refined; scratch.
    pub(super) required: List,
    /// Whether the forces of the set, without contacts, match the current displacements.
    pub(super) current: bool,
    /// Whether the fixed nodes have changed since the set was chosen.
    pub(super) outdated: bool,
    /// Relative change of size from which on a brick stays in the set.
    pub(super) keep_strained: f32,
    /// Bricks with outdated forces.
    pub(super) stale: List,
    /// Visited nodes; scratch.
    pub(super) touched: List,
    /// Nodes that moved in this step, and their displacements before it.
    pub(super) moved_on: List,
    pub(super) start: Vec<Vec3>,
    pub(super) since: SetChange,
    /// Nodes that were free at the start of this step.
    pub(super) settled: List,
    /// Whether the shape is still the reference state.
    pub(super) at_reference: bool,
    /// Largest displacement of any node so far in m.
    pub(super) displaced: f64,
    pub(super) move_max: f64,
    pub(super) clamped: usize,
    /// Bricks computed in this step.
    pub(super) visits: usize,
    /// Diagonal blocks of the active nodes without contacts, and of the nodes in contact with them; scratch.
    pub(super) blocks: Vec<[f32; 6]>,
    pub(super) pressed: Vec<[f32; 6]>,
    /// Sum of the diagonal blocks of each brick when last computed, and of each form at rest.
    pub(super) block_sum: Vec<[f32; 6]>,
    pub(super) block_sum_at_rest: Vec<Option<[f32; 6]>>,
    /// Diagonal blocks at rest of forms that several bricks share.
    pub(super) blocks_at_rest: Vec<Option<Box<JacobiBlocks>>>,
    /// Correction of each node by level 1 in this iteration; scratch.
    pub(super) moved: Vec<(u32, Vec3)>,
    pub(super) old: Vec<Quad>,
    scratch: Box<Ends<3>>,
    pub(super) block_scratch: Box<Ends<6>>,
    pub(super) arch: Arch,
    /// Mechanisms that an ablation has switched off.
    pub(super) disabled: Disabled,
}

impl FineLevel {
    /// `own` is the stiffness of each node, from [`own_stiffness`].
    pub(super) fn new(topology: &Topology, hierarchy: &Hierarchy, own: Vec<f64>) -> Self {
        let nodes = topology.node_count();
        Self {
            fixed: (0..nodes as u32).map(|n| topology.is_pinned(n)).collect(),
            own,
            weights: weights(topology),
            forces: laid_out([[0.0; LOCALS]; 3], hierarchy.bricks.len()),
            computed: List::new(hierarchy.bricks.len()),
            kept: Vec::new(),
            r: laid_out(ZERO, nodes),
            inverse: laid_out([0.0; 6], nodes),
            d: laid_out(ZERO, nodes),
            applied: laid_out([0.0; 3], nodes),
            set: List::new(hierarchy.bricks.len()),
            left: List::new(hierarchy.bricks.len()),
            nodes: List::new(nodes),
            inside: laid_out(0, nodes),
            free: laid_out(false, nodes),
            unbalanced: List::new(nodes),
            below_threshold: List::new(nodes),
            disturbed: List::new(nodes),
            outer_forces: OuterForces::Changed,
            required: List::new(hierarchy.levels[0].corners.len()),
            current: false,
            outdated: true,
            keep_strained: f32::INFINITY,
            stale: List::new(hierarchy.bricks.len()),
            touched: List::new(nodes),
            moved_on: List::new(nodes),
            start: laid_out(Vec3::zeros(), nodes),
            since: SetChange::Replaced,
            settled: List::new(nodes),
            at_reference: true,
            displaced: 0.0,
            move_max: 0.0,
            clamped: 0,
            visits: 0,
            blocks: laid_out([0.0; 6], nodes),
            pressed: Vec::new(),
            block_sum: laid_out([0.0; 6], hierarchy.bricks.len()),
            block_sum_at_rest: laid_out(None, hierarchy.forms.len()),
            blocks_at_rest: vec![None; hierarchy.forms.len()],
            moved: Vec::new(),
            old: Vec::new(),
            scratch: Box::new(Ends::new()),
            block_scratch: Box::new(Ends::new()),
            arch: Arch::new(),
            disabled: Disabled::default(),
        }
    }

    /// Marks the forces of the bricks around a node as outdated.
    pub(super) fn disturb(&mut self, hierarchy: &Hierarchy, node: u32) {
        for &entry in hierarchy.around.row(node) {
            self.stale.insert(entry / 32);
        }
    }

    /// Marks all bricks as outdated.
    pub(super) fn disturb_all(&mut self) {
        for brick in 0..self.forces.len() as u32 {
            self.stale.insert(brick);
        }
    }

    /// Removes contact forces from their nodes before contacts are searched again.
    pub(super) fn remove_contacts(&mut self, hierarchy: &Hierarchy, nodes: &[u32]) {
        for &node in nodes {
            self.r[node as usize] = self.sum(hierarchy, node);
            self.unbalanced.insert(node);
            if !self.nodes.contains(node) {
                self.outer_forces = OuterForces::Changed;
            }
            if !self.free[node as usize] {
                self.disturbed.insert(node);
            }
        }
    }

    /// Number of nodes with a possibly nonzero force.
    pub(super) fn unbalanced_count(&self) -> usize {
        self.unbalanced.items.len()
    }

    /// Recomputes outdated bricks.
    pub(super) fn refresh(&mut self, hierarchy: &Hierarchy, u: &[Vec3]) {
        if self.stale.items.is_empty() {
            return;
        }
        self.outer_forces = OuterForces::Changed;
        self.stale.sort();
        let list = std::mem::take(&mut self.stale.items);
        self.compute(hierarchy, u, &list);
        for &brick in &list {
            let b = &hierarchy.bricks[brick as usize];
            for (i, &node) in b.nodes.iter().enumerate() {
                if b.present >> i & 1 == 1 && self.touched.insert(node) {
                    self.unbalanced.insert(node);
                    self.r[node as usize] = self.sum(hierarchy, node);
                    if !self.free[node as usize] {
                        self.disturbed.insert(node);
                    }
                }
            }
        }
        self.touched.clear();
        self.stale.items = list;
        self.stale.clear();
    }

    /// Adds to a node the displacement of level 1 that it has not yet received.
    #[inline]
    pub(super) fn follow_coarser(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        u: &mut [Vec3],
        node: u32,
    ) {
        let n = node as usize;
        let v = hierarchy
            .prolongation
            .interpolate_exactly(n, &coarse.grids[0].total);
        let old = self.applied[n];
        if v != old {
            self.applied[n] = v;
            if !self.fixed[n] {
                self.shift(
                    u,
                    node,
                    Vec3::new(v[0] - old[0], v[1] - old[1], v[2] - old[2]),
                );
            }
        }
    }

    /// Prolongates the displacements of level 1 that changed by more than `least` m since the last call. The levels above
    /// are done by `coarse_level::prolongate_changes`. [`undo`](Self::undo) does not revert these moves: the totals must be
    /// finite.
    pub(super) fn prolongate(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &mut Multigrid,
        u: &mut [Vec3],
        least: f64,
    ) {
        let moved = coarse.grids[0].take_moved(&hierarchy.levels[0], least);
        let mut displaced = self.displaced.powi(2);
        for (element, _) in (0..).zip(moved).filter(|(_, has_moved)| *has_moved) {
            for &node in hierarchy.nodes_of.row(element) {
                let n = node as usize;
                // Nodes of the set are always up to date.
                if self.nodes.contains(node) {
                    continue;
                }
                let total = &coarse.grids[0].total;
                let now = hierarchy.prolongation.interpolate_exactly(n, total);
                let old = std::mem::replace(&mut self.applied[n], now);
                if !self.fixed[n] {
                    u[n] += Vec3::from(now) - Vec3::from(old);
                    displaced = displaced.max(u[n].norm_squared());
                }
            }
            self.at_reference = false;
        }
        self.displaced = displaced.sqrt();
    }

    /// Brings these nodes up to date with level 1.
    pub(super) fn prolongate_at(
        &mut self,
        hierarchy: &Hierarchy,
        coarse: &Multigrid,
        u: &mut [Vec3],
        nodes: &[u32],
    ) {
        for &node in nodes {
            self.follow_coarser(hierarchy, coarse, u, node);
        }
    }

    /// Forces of these bricks.
    pub(super) fn compute(&mut self, hierarchy: &Hierarchy, u: &[Vec3], list: &[u32]) {
        self.visits += list.len();
        for &brick in list {
            self.computed.insert(brick);
        }
        let arch = self.arch;
        let one = |brick: u32, to: &mut [[f32; LOCALS]; 3], scratch: &mut Ends<3>| {
            let b = &hierarchy.bricks[brick as usize];
            let form = &hierarchy.forms[b.form as usize];
            arch.dispatch(Forces {
                brick: b,
                form,
                u,
                to,
                scratch,
            });
        };
        if list.len() < PARALLEL || rayon::current_num_threads() == 1 {
            for &brick in list {
                one(brick, &mut self.forces[brick as usize], &mut self.scratch);
            }
        } else {
            let mut member = vec![false; self.forces.len()];
            for &brick in list {
                member[brick as usize] = true;
            }
            self.forces
                .par_iter_mut()
                .enumerate()
                .with_min_len(64)
                .filter(|(b, _)| member[*b])
                .for_each_init(Ends::new, |scratch, (b, to)| one(b as u32, to, scratch));
        }
    }

    fn compute_set(&mut self, hierarchy: &Hierarchy, u: &[Vec3]) {
        let list = std::mem::take(&mut self.set.items);
        self.compute(hierarchy, u, &list);
        self.set.items = list;
        self.sum_up(hierarchy);
        self.current = true;
    }

    /// Saves the forces of the active bricks.
    pub(super) fn keep_forces(&mut self) {
        self.kept.clear();
        let forces = &self.forces;
        let of = |&brick: &u32| forces[brick as usize];
        self.kept.extend(self.set.items.iter().map(of));
    }

    /// Interpolates the forces of the active bricks between the saved ones and the last computed ones, without
    /// contacts.
    pub(super) fn blend_forces(&mut self, hierarchy: &Hierarchy, share: f32) {
        for (&brick, kept) in self.set.items.iter().zip(&self.kept) {
            let forces = self.forces[brick as usize].as_flattened_mut();
            for (f, from) in forces.iter_mut().zip(kept.as_flattened()) {
                *f = from + share * (*f - from);
            }
        }
        self.sum_up(hierarchy);
        self.current = true;
    }

    /// Sum of the squares of the weights in N².
    pub(super) fn square_of_weights(&self) -> f64 {
        self.weights.iter().map(|w| f64::from(square(w))).sum()
    }

    /// Sums the cached brick forces on the nodes of the set.
    pub(super) fn sum_up(&mut self, hierarchy: &Hierarchy) {
        for i in 0..self.nodes.items.len() {
            let node = self.nodes.items[i];
            self.r[node as usize] = self.sum(hierarchy, node);
        }
    }

    #[inline]
    pub(super) fn sum(&self, hierarchy: &Hierarchy, node: u32) -> Quad {
        let mut sum = *self.weights.get(node as usize).unwrap_or(&ZERO);
        for &entry in hierarchy.around.row(node) {
            let f = &self.forces[(entry / 32) as usize];
            let i = (entry % 32) as usize;
            for a in 0..3 {
                sum[a] += f[a][i];
            }
        }
        sum
    }

    /// Sum of the squares of the forces on the nodes of the set that are not fixed.
    pub(super) fn square_over_unfixed(&self) -> f64 {
        let free = self
            .nodes
            .items
            .iter()
            .filter(|&&n| !self.fixed[n as usize]);
        free.map(|&n| f64::from(square(&self.r[n as usize]))).sum()
    }

    /// Recomputes the active bricks and the forces on their nodes, without contacts.
    pub(super) fn evaluate_bricks(&mut self, hierarchy: &Hierarchy, u: &[Vec3]) {
        if !std::mem::take(&mut self.current) {
            self.compute_set(hierarchy, u);
            self.current = false;
        }
    }

    /// Adds the contact forces to their nodes, or subtracts them with a `sign` of -1.
    pub(super) fn add_contacts(&mut self, u: &[Vec3], contacts: &Contacts, sign: f64) {
        let r = &mut self.r;
        contacts.pressed(u, |sample, force, _, _| {
            for (node, w) in sample.nodes.iter().zip(sample.weights) {
                let r = &mut r[*node as usize];
                for a in 0..3 {
                    r[a] += (sign * w * force[a]) as f32;
                }
            }
        });
    }

    /// Force of the bricks on one node plus its weight, evaluated at `u`.
    pub(super) fn force_on(&self, hierarchy: &Hierarchy, u: &[Vec3], node: u32) -> Vec3 {
        let [x, y, z, _] = *self.weights.get(node as usize).unwrap_or(&ZERO);
        let mut sum = Vec3::new(x.into(), y.into(), z.into());
        for &entry in hierarchy.around.row(node) {
            let b = &hierarchy.bricks[(entry / 32) as usize];
            let form = &hierarchy.forms[b.form as usize];
            let i = (entry % 32) as usize;
            let mut f = [[0.0; LOCALS]; 3];
            self.arch.dispatch(Forces {
                brick: b,
                form,
                u,
                to: &mut f,
                scratch: &mut Ends::new(),
            });
            sum += Vec3::new(f64::from(f[0][i]), f64::from(f[1][i]), f64::from(f[2][i]));
        }
        sum
    }

    /// Recomputes every brick; returns the sum of squares over all unfixed nodes.
    pub(super) fn square_over_all(
        &mut self,
        hierarchy: &Hierarchy,
        u: &[Vec3],
        contacts: &Contacts,
    ) -> f64 {
        for brick in 0..hierarchy.bricks.len() as u32 {
            self.stale.insert(brick);
        }
        self.refresh(hierarchy, u);
        let mut r: Vec<[f64; 3]> = self
            .r
            .iter()
            .map(|f| [0, 1, 2].map(|a| f64::from(f[a])))
            .collect();
        contacts.pressed(u, |sample, force, _, _| {
            for (node, w) in sample.nodes.iter().zip(sample.weights) {
                for a in 0..3 {
                    r[*node as usize][a] += w * force[a];
                }
            }
        });
        let free = (0..r.len()).filter(|&n| !self.fixed[n]);
        free.map(|n| r[n].iter().map(|v| v * v).sum::<f64>()).sum()
    }
}

/// Mean stiffness of a node at rest in N/m.
pub(super) fn own_stiffness(topology: &Topology, node: u32) -> f64 {
    topology.stiffness_around(node) / 3.0
}

/// `k n nᵀ`.
pub(super) fn contact_block(k: f64, n: &Vec3) -> [f32; 6] {
    [
        k * n.x * n.x,
        k * n.y * n.y,
        k * n.z * n.z,
        k * n.x * n.y,
        k * n.x * n.z,
        k * n.y * n.z,
    ]
    .map(|v| v as f32)
}
