//! Reference state: the equilibrium without tools and held nodes.
//!
//! Without gravity it is the rest shape. With gravity it is solved once per topology. Quick steps leave residual
//! displacements of a few tenths of a millimetre and residual forces after a release; these reduced the accuracy of the
//! next press, and at 2 mm spacing cost 15 ms in every later step. So once all tools are clear of the tissue in its
//! reference state, the shape is set to it. A tool that is still inside that state waits for the tissue to reach it.

use std::sync::Arc;

use super::brick::LOCALS;
use super::budget::Budget;
use super::coarse_level::CoarseLevel;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, OuterForces, SetChange};
use super::hierarchy::Hierarchy;
use super::mechanism::Mechanism;
use super::quad::ZERO;
use super::solver::Solver;
use super::work_limit::WorkLimit;
use crate::{Shape, Topology, Vec3};

/// Relative residual of the reference state under gravity, and the maximum of iterations.
const TOLERANCE: f64 = 1e-4;
const ITERATIONS: usize = 300;

/// Convergence of the equilibrium under gravity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sag {
    /// Largest displacement of a node by gravity in m.
    pub displaced_m: f64,
    /// Remaining residual relative to the weights.
    pub residual: f64,
    /// Iterations made.
    pub iterations: usize,
}

/// Shape and brick forces under gravity.
pub(super) struct ReferenceState {
    pub(super) displacement: Vec<Vec3>,
    forces: Vec<[[f32; LOCALS]; 3]>,
    /// Root of the sum of squares of the weights, in N.
    weight: f64,
    sag: Sag,
}

impl ReferenceState {
    /// The reference state of a topology, solved from the one of an earlier topology; `None` without weight.
    pub(super) fn of(
        topology: &Topology,
        hierarchy: &Hierarchy,
        own: Vec<f64>,
        earlier: Option<&Self>,
    ) -> Option<Arc<Self>> {
        if topology.model().gravity == [0.0; 3] {
            return None;
        }
        let fine = FineLevel::new(topology, hierarchy, own);
        let mut solver = Solver::with(topology, hierarchy.clone(), fine, None);
        let mut shape = Shape::rest(topology);
        if let Some(earlier) = earlier {
            for (node, u) in (0..).zip(&mut shape.displacement) {
                // A doubled node starts from the displacement of its origin.
                let known = earlier.displacement.get(node as usize);
                *u = *known.unwrap_or(&earlier.displacement[topology.origin(node) as usize]);
            }
        }
        solver.fine.disturb_all();
        solver.dirty = true;
        let budget = Budget::new(ITERATIONS, TOLERANCE);
        let report = solver.step(topology, &mut shape, &[], budget);
        let (residual, iterations) = (report.residual, report.iterations);
        // Evaluates every brick at the final shape.
        solver.residual_over_all(&shape);
        let longest = shape.displacement.iter().map(Vec3::norm);
        Some(Arc::new(Self {
            sag: Sag {
                displaced_m: longest.fold(0.0, f64::max),
                residual,
                iterations,
            },
            displacement: shape.displacement,
            weight: solver.fine.square_of_weights().sqrt(),
            forces: solver.fine.forces,
        }))
    }

    /// Forces of a brick on its nodes in N.
    pub(super) fn of_brick(&self, brick: u32) -> &[[f32; LOCALS]; 3] {
        &self.forces[brick as usize]
    }
}

impl Solver {
    pub(crate) fn sag(&self) -> Option<Sag> {
        self.reference_state.as_ref().map(|h| h.sag)
    }

    pub(crate) fn sag_of(&self, node: u32) -> Vec3 {
        let known = self
            .reference_state
            .as_ref()
            .and_then(|h| h.displacement.get(node as usize));
        known.copied().unwrap_or_else(Vec3::zeros)
    }

    /// Reference force in N of residuals without tools.
    pub(super) fn reference_force(&self) -> f64 {
        self.reference_state.as_ref().map_or(0.0, |h| h.weight)
    }

    /// Before the first step: an undeformed shape starts from the equilibrium under gravity.
    pub(super) fn start_at_reference_state(&mut self, shape: &mut Shape) {
        let reference_state = self.reference_state.clone().filter(|_| !self.has_started);
        let Some(reference_state) = reference_state else {
            return;
        };
        self.has_started = true;
        let u = &mut shape.displacement;
        let unmoved = |n: usize| self.fine.fixed[n] || u[n] == Vec3::zeros();
        if !(0..u.len()).all(unmoved) {
            self.coarse.grids[0].starts_at_reference = false;
            self.fine.disturb_all();
            self.dirty = true;
            return;
        }
        for (n, u) in u.iter_mut().enumerate() {
            if !self.fine.fixed[n] {
                *u = reference_state.displacement[n];
            }
        }
        self.reference = self.reference_force();
        let held = self.held.clone();
        self.fine.forces.clone_from(&reference_state.forces);
        self.fine.displaced = self.fine.displaced.max(reference_state.sag.displaced_m);
        for node in held {
            self.fine.disturb(&self.hierarchy, node);
        }
    }

    /// Sets the shape to the reference state if no tool or held node prevents it. Returns whether it changed.
    pub(super) fn restore_reference_state(
        &mut self,
        topology: &Topology,
        shape: &mut Shape,
    ) -> bool {
        let sag = self.sag().map_or(0.0, |s| s.displaced_m);
        let clear = || self.contacts.are_clear(topology, &shape.displacement, sag);
        let returns = self.uses(Mechanism::ReferenceReturn);
        if !returns || self.fine.at_reference || !self.held.is_empty() || !clear() {
            return false;
        }
        let reference_state = self.reference_state.as_deref();
        match reference_state {
            Some(reference_state) => shape.displacement.clone_from(&reference_state.displacement),
            None => shape.displacement.fill(Vec3::zeros()),
        }
        self.fine.rest(&self.hierarchy, reference_state);
        self.coarse.rest();
        self.contacts.rest();
        self.prescribed_from.clear();
        self.work_limit = WorkLimit::NONE;
        self.reference = self.reference_force();
        self.report.reactions.clear();
        self.dirty = false;
        true
    }
}

impl FineLevel {
    fn rest(&mut self, hierarchy: &Hierarchy, reference_state: Option<&ReferenceState>) {
        let bricks = self.computed.take();
        for &brick in &bricks {
            let b = brick as usize;
            self.forces[b] = reference_state.map_or([[0.0; LOCALS]; 3], |h| h.forces[b]);
            self.block_sum[b] = [0.0; 6];
        }
        for &brick in &bricks {
            for &node in &hierarchy.bricks[brick as usize].nodes {
                self.r[node as usize] = match reference_state {
                    Some(_) => self.sum(hierarchy, node),
                    None => ZERO,
                };
            }
        }
        self.applied.fill([0.0; 3]);
        self.outer_forces = OuterForces::Changed;
        for list in [
            &mut self.unbalanced,
            &mut self.below_threshold,
            &mut self.disturbed,
            &mut self.stale,
            &mut self.moved_on,
            &mut self.settled,
        ] {
            list.clear();
        }
        self.since = SetChange::Replaced;
        self.current = false;
        self.outdated = true;
        self.at_reference = true;
        self.displaced = reference_state.map_or(0.0, |h| h.sag.displaced_m);
    }
}

impl Multigrid {
    fn rest(&mut self) {
        self.grids.iter_mut().for_each(CoarseLevel::rest);
    }
}
