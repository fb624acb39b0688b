//! What a step may cost, and what it did.

use crate::contact::Reaction;

/// What a step may cost.
pub struct Budget<'a> {
    /// Iterations at most (three at the first touch with `near`, if that is more); one iteration is a coarse
    /// correction and three smoothing steps over what is active.
    pub iterations: usize,
    /// Relative residual at which to stop; 1e-6 counts as converged. From 0.02 on a step under tools is
    /// solved as with `near`, and then poured out.
    pub tolerance: f64,
    /// Whether nodes far from the tools may wait: they are then brought up to date by
    /// [`Solver::pour`](crate::Solver::pour), and a step costs what is near. The tolerance is then 0.02 at least.
    pub near: bool,
    /// Asked between iterations; `true` stops. A shell that owns a clock sets a time limit so. There is always
    /// one iteration, and up to three where a tool has jumped, or with `near` has just touched the tissue.
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

    /// Whether the shell says that time is over.
    pub(super) fn is_over(&mut self) -> bool {
        self.stop.as_mut().is_some_and(|stop| stop())
    }
}

/// What a step did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepReport {
    /// Norm of the forces left on nodes free to move, over the norm of the forces that tools and
    /// held nodes bring in.
    pub residual: f64,
    /// Iterations made.
    pub iterations: usize,
    /// Bricks of eight cells computed, and elements of coarse levels visited: what the step cost,
    /// whatever the machine.
    pub visits: [usize; 2],
    /// Nodes still active.
    pub active_nodes: usize,
    /// Moves that were cut short: zero in moderate presses.
    pub clamped: usize,
    /// Tools ignored: not finite, no radius, an id twice, or beyond the number looked at.
    pub ignored_tools: usize,
    /// Farthest that a proxy is behind its tool, in m; zero unless a tool jumped.
    pub lag_m: f64,
    /// Whether the last iteration changed no tool's force by more than half a percent.
    pub steady: bool,
    /// Whether an iterate was thrown away and the shape before the step put back.
    pub fell_back: bool,
    /// One per tool, in the order in which tools first appeared.
    pub reactions: Vec<Reaction>,
}
