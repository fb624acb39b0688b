//! Limits and report of a step.

use super::solver::Solver;
use crate::contact::Reaction;
use crate::{Topology, Vec3};

/// Relative change of a tool's force in the last iteration above which a quick step iterates again; see DECISIONS.md.
pub(crate) const STEADY: f64 = 5e-3;

/// Displacement in spacings of the lattice above which an iterate counts as diverged.
const BLOWN_UP: f64 = 1e4;

/// Limits of a step.
pub struct Budget<'a> {
    /// Maximum iterations (three at first touch in a quick step, if that is more). One iteration is a coarse correction
    /// and three smoothing steps over the active set.
    pub iterations: usize,
    /// Relative residual at which to stop; 1e-6 counts as converged. From 0.02 a step without held nodes is quick: it stops
    /// at a quarter of this, and elements beyond the active set defer their residual. Nodes follow the coarse levels to
    /// within 0.01 mm.
    pub tolerance: f64,
    /// A quick step that leaves the nodes far from the tools where they are. The next cut or full step moves them.
    pub near: bool,
    /// Called between iterations; `true` stops, for example at a time limit. One iteration is always made.
    pub stop: Option<&'a mut dyn FnMut() -> bool>,
}

impl Budget<'_> {
    /// Up to `iterations` iterations or a relative residual of `tolerance`.
    pub fn new(iterations: usize, tolerance: f64) -> Self {
        Self {
            iterations,
            tolerance,
            near: false,
            stop: None,
        }
    }

    /// Whether the caller stops the iteration.
    pub(super) fn is_over(&mut self) -> bool {
        self.stop.as_mut().is_some_and(|stop| stop())
    }
}

/// Report of a step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepReport {
    /// Norm of the residual forces on free nodes, relative to the norm of the forces of tools and held nodes.
    pub residual: f64,
    /// Iterations made.
    pub iterations: usize,
    /// Bricks of eight cells computed, and coarse elements visited: a cost that does not depend on the machine.
    pub visits: [usize; 2],
    /// Nodes still active.
    pub active_nodes: usize,
    /// Moves that were clamped: zero in moderate presses.
    pub clamped: usize,
    /// Tools ignored: not finite, without radius, with a repeated id, or above the maximum number.
    pub ignored_tools: usize,
    /// Largest distance between a proxy and its tool in m; zero unless tissue has yet to yield to a tool.
    pub lag_m: f64,
    /// Whether the last iteration changed no tool's force by more than half a percent.
    pub steady: bool,
    /// Whether a diverged iterate was discarded and the shape before the step restored.
    pub rolled_back: bool,
    /// One per tool, in the order in which tools first appeared.
    pub reactions: Vec<Reaction>,
}

/// Norm of a residual with this sum of squares, relative to the reference.
pub(super) fn relative(sum: f64, reference: f64) -> f64 {
    if sum == 0.0 {
        0.0
    } else if reference > 0.0 {
        sum.sqrt() / reference
    } else {
        1.0
    }
}

impl Solver {
    pub(super) fn remember_forces(&mut self, u: &[Vec3]) {
        self.last_forces.clear();
        for i in 0..self.contacts.proxies.len() {
            let (force, _) = self.contacts.force(u, i);
            self.last_forces.push(force);
        }
    }

    /// Whether the last iteration changed every tool's force by at most [`STEADY`].
    pub(super) fn are_forces_steady(&self, u: &[Vec3]) -> bool {
        self.last_forces.iter().enumerate().all(|(i, last)| {
            let (force, _) = self.contacts.force(u, i);
            (force - last).norm() <= STEADY * force.norm()
        })
    }

    pub(super) fn is_sane(&self, topology: &Topology, u: &[Vec3]) -> bool {
        let limit = BLOWN_UP * topology.model().spacing_m;
        let is_finite = self.report.residual.is_finite();
        is_finite && self.fine.is_within(u, limit) && self.coarse.is_within(limit)
    }

    /// Last stage: reactions and statistics.
    pub(super) fn report_reactions(&mut self, topology: &Topology, u: &[Vec3]) {
        let spacing = topology.model().spacing_m;
        self.report.reactions.clear();
        self.report.lag_m = 0.0;
        let untouched = self
            .reference_state
            .as_ref()
            .map(|h| h.displacement.as_slice());
        for i in 0..self.contacts.proxies.len() {
            let mut reaction = self.contacts.reaction(topology, u, untouched, i);
            self.report.lag_m = self.report.lag_m.max(self.contacts.proxies[i].lag());
            if reaction.contacts > 0 {
                let own = self.fine.own[self.contacts.nodes[0] as usize];
                reaction.stiffness = self.contacts.learn(u, i, &reaction, own, spacing);
                if let Some(last) = self.last_forces.get(i) {
                    reaction.force_error = (reaction.force - last).norm();
                }
            }
            let own = &self.fine.own;
            reaction.is_inserted = self.contacts.end_insertion(topology, u, own, i);
            self.report.reactions.push(reaction);
        }
        self.report.steady &= !self.contacts.is_unsettled && !self.contacts.are_proxies_following();
        self.report.active_nodes = self.fine.nodes.items.len();
        self.report.visits = [self.fine.visits, self.coarse.visits];
        self.report.clamped = self.fine.clamped;
        if self.report.active_nodes == 0 && self.contacts.nodes.is_empty() && self.held.is_empty() {
            self.reference = self.reference_force();
            self.report.residual = 0.0;
        }
    }
}
