//! Limits and report of a step.

use crate::contact::Reaction;

/// Limits of a step.
pub struct Budget<'a> {
    /// Maximum iterations (three at first touch in a quick step, if that is more). One iteration is a coarse correction
    /// and three smoothing steps over the active set.
    pub iterations: usize,
    /// Relative residual at which to stop; 1e-6 counts as converged. From 0.02 a step without held nodes is quick:
    /// elements beyond the active set defer their residual. Nodes follow the coarse levels to within 0.01 mm.
    pub tolerance: f64,
    /// A quick step that leaves the nodes far from the tools where they are. They are updated by
    /// [`Solver::prolongate_all`](crate::Solver::prolongate_all).
    pub near: bool,
    /// Called between iterations; `true` stops, for example at a time limit. One iteration is always made, and up to
    /// three where a tool has jumped, or in a quick step has just touched the tissue.
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
    /// Largest distance between a proxy and its tool in m; zero unless a tool jumped.
    pub lag_m: f64,
    /// Whether the last iteration changed no tool's force by more than half a percent.
    pub steady: bool,
    /// Whether a diverged iterate was discarded and the shape before the step restored.
    pub fell_back: bool,
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
