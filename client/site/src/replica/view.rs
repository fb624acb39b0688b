//! The view of the tissue: solved at common times, and compared with the server's corrections.
//!
//! It is separate from the [`Replica`](crate::Replica), so that a view of many milliseconds never delays the hand.
//! Pure: no thread, no clock.

use std::sync::Arc;

use palpate_protocol::ServerTime;
use palpate_protocol::datagram::Corrections;
use palpate_tissue::{
    Budget, CutOutcome, Follower, Shape, StepReport, Successor, Tool, Topology, Vec3,
};

use super::Side;
use super::history::History;
use crate::tools::{ToolAt, gather};

/// Node distance from the server that triggers a correction, m; smaller differences are tolerated.
const DRIFT_TOLERATED_M: f64 = 0.05e-3;

/// Fraction of the difference that one correction removes. The equilibrium removes the rest; a larger fraction would
/// be visible as a twitch.
const BLEND: f64 = 0.3;

/// Iterations per view: the same number as the server's.
pub const VIEW_ITERATIONS: usize = 1;

/// Residual at which the view's solve ends.
pub const VIEW_TOLERANCE: f64 = 2e-2;

/// Difference of a view from the server.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Drift {
    /// Largest node distance, m.
    pub max_m: f64,
    /// Corrected nodes.
    pub nodes: usize,
}

/// A cut for the view.
pub struct ViewCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) outcome: CutOutcome,
    pub(crate) successor: Successor,
}

/// The view of the tissue. Calling order: [`take`](Self::take) for every cut in log order; in between
/// [`step`](Self::step) with ascending times, and [`correct`](Self::correct) on corrections.
pub struct View {
    topology: Arc<Topology>,
    side: Side,
    history: History,
    was_corrected: bool,
    tools: Vec<Tool>,
}

impl View {
    pub(crate) fn new(topology: &Arc<Topology>) -> Self {
        Self {
            topology: Arc::clone(topology),
            side: Side::new(topology),
            history: History::default(),
            was_corrected: false,
            tools: Vec::new(),
        }
    }

    /// A side on the same topology for a hand.
    pub(crate) fn another_side(&self) -> Side {
        self.side.another(&self.topology)
    }

    pub(crate) fn follower(&self) -> Follower {
        self.side.solver.follower()
    }

    /// The shape of the view.
    pub fn shape(&self) -> &Shape {
        &self.side.shape
    }

    /// The topology of the view.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// Adopts a cut.
    pub fn take(&mut self, cut: ViewCut) {
        self.topology = cut.topology;
        self.side
            .succeed(&self.topology, &cut.outcome, cut.successor);
        self.history.clear();
    }

    /// Solves the view at time `s`.
    pub fn step(&mut self, s: ServerTime, tools: &[ToolAt], budget: Budget<'_>) -> &StepReport {
        gather(&mut self.tools, tools.iter());
        let side = &mut self.side;
        side.solver
            .step(&self.topology, &mut side.shape, &self.tools, budget);
        let changed = self.was_corrected || side.solver.report().visits[0] > 0;
        self.was_corrected = false;
        self.history
            .push(s, self.topology.version(), &side.shape, changed);
        side.solver.report()
    }

    /// Compares a past view with the server's corrections, and blends the difference into the present one. `None` if
    /// that view is not kept or has another topology.
    pub fn correct(&mut self, corrections: &Corrections) -> Option<Drift> {
        if corrections.topology_version != self.topology.version() {
            return None;
        }
        let s = corrections.view_time;
        let known = self.history.at(s, corrections.topology_version)?;
        let mut drift = Drift::default();
        let mut disturbed = Vec::new();
        for &(node, theirs) in &corrections.nodes {
            if node as usize >= self.topology.node_count() || self.topology.is_pinned(node) {
                continue;
            }
            let Some(ours) = known.displacement(node) else {
                continue;
            };
            let difference = Vec3::from(theirs.map(f64::from)) - ours;
            drift.max_m = drift.max_m.max(difference.norm());
            if difference.norm() > DRIFT_TOLERATED_M && self.history.is_news(node, s) {
                self.side.shape.displacement[node as usize] += difference * BLEND;
                disturbed.push(node);
            }
        }
        if !disturbed.is_empty() {
            drift.nodes = disturbed.len();
            self.was_corrected = true;
            let side = &mut self.side;
            side.solver.disturb(&side.shape, &disturbed);
        }
        Some(drift)
    }
}

#[cfg(test)]
mod tests;
