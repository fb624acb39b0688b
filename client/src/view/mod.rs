//! The tissue as everybody sees it: solved for the common moments, compared with what the server says.
//!
//! It is a machine of its own beside the [`Replica`](crate::Replica), so that a view, which may take
//! many milliseconds, never keeps a hand waiting. Pure: no thread (that is in `thread`), no clock.

mod thread;

use std::sync::Arc;

use palpate_protocol::ServerTime;
use palpate_protocol::datagram::Corrections;
use palpate_tissue::{
    Budget, CutOutcome, Follower, Shape, StepReport, Successor, Tool, Topology, Vec3,
};

pub(crate) use thread::{Order, ViewReport, ViewThread, record};

use crate::history::History;
use crate::replica::Side;
use crate::roster::{ToolAt, gather};

/// A node this far from where the server has it is corrected, m; below it sites are alike.
pub const DRIFT_TOLERATED_M: f64 = 0.05e-3;

/// Part of the difference that a correction takes away at once. The equilibrium does the rest; more
/// would show as a twitch.
const BLEND: f64 = 0.3;

/// Residual at which the view's solve ends. Finer than the hand's, because sites are compared.
pub const VIEW_TOLERANCE: f64 = 2e-2;

/// How far the view was from what the server said.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Drift {
    /// The farthest node, m.
    pub max_m: f64,
    /// Nodes that were corrected.
    pub nodes: usize,
}

/// A cut, for the view to take over.
pub struct ViewCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) outcome: CutOutcome,
    pub(crate) successor: Successor,
}

/// What everybody sees.
///
/// Calling order: [`take`](Self::take) every cut in the order of the log; between them
/// [`step`](Self::step) with ascending moments, and [`correct`](Self::correct) as news come.
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

    /// A side of the same topology for a hand.
    pub(crate) fn another_side(&self) -> Side {
        self.side.another(&self.topology)
    }

    pub(crate) fn follower(&self) -> Follower {
        self.side.solver.follower()
    }

    /// The shape that is seen.
    pub fn shape(&self) -> &Shape {
        &self.side.shape
    }

    /// The topology that it is seen of.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// Takes a cut over.
    pub fn take(&mut self, cut: ViewCut) {
        self.topology = cut.topology;
        self.side
            .succeed(&self.topology, &cut.outcome, cut.successor);
        self.history.clear();
    }

    /// Solves what everybody sees at the moment `s`.
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

    /// Compares a past view with what the server says of it, and blends the difference into the
    /// present one. `None` when that view is not remembered or was of another topology.
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
