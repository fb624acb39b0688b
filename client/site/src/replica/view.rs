//! The view of the tissue: solved at common times, and compared with the server's corrections.
//!
//! It is separate from the [`Replica`](crate::Replica), so that a view of many milliseconds never delays the hand.
//! Pure: no thread, no clock.

use std::sync::Arc;

use palpate_protocol::ServerTime;
use palpate_protocol::datagram::Corrections;
use palpate_protocol::tool::part_id;
use palpate_tissue::{
    Blades, Budget, CutPreparer, PreparedCut, Reaction, Shape, StepReport, Tissue, Tool, Topology,
    Vec3,
};

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

/// The view of the tissue. Calling order: [`take`](Self::take) for every cut in log order; in between
/// [`step`](Self::step) with ascending times, and [`correct`](Self::correct) on corrections.
pub struct View {
    tissue: Tissue,
    history: History,
    was_corrected: bool,
    tools: Vec<Tool>,
    blades: Blades,
}

impl View {
    pub(crate) fn new(tissue: Tissue) -> Self {
        Self {
            tissue,
            history: History::default(),
            was_corrected: false,
            tools: Vec::new(),
            blades: Blades::default(),
        }
    }

    /// A tissue on the same topology for a hand.
    pub(crate) fn another_tissue(&self) -> Tissue {
        self.tissue.another()
    }

    pub(crate) fn preparer(&self) -> CutPreparer {
        self.tissue.preparer()
    }

    /// The tissue of the view.
    pub fn tissue(&self) -> &Tissue {
        &self.tissue
    }

    /// The shape of the view.
    pub fn shape(&self) -> &Shape {
        self.tissue.shape()
    }

    /// The topology of the view.
    pub fn topology(&self) -> &Arc<Topology> {
        self.tissue.topology()
    }

    /// Adopts a cut.
    pub fn take(&mut self, cut: PreparedCut) {
        self.tissue.succeed(cut);
        self.history.clear();
    }

    /// Solves the view at time `s`.
    pub fn step(&mut self, s: ServerTime, tools: &[ToolAt], budget: Budget<'_>) -> &StepReport {
        gather(&mut self.tools, tools.iter());
        self.tissue.step(&self.tools, budget);
        let changed = self.was_corrected || self.tissue.report().visits[0] > 0;
        self.was_corrected = false;
        let version = self.topology().version();
        self.history.push(s, version, self.tissue.shape(), changed);
        self.tissue.report()
    }

    /// The reactions of the latest step on these tools, cutting blades included.
    pub fn reactions(&mut self, tools: &[ToolAt]) -> Vec<Reaction> {
        let shown = tools.iter().filter(|tool| tool.strength > 0.0);
        let edge = |tool: &ToolAt| Some((part_id(tool.participant, 0), tool.edge()?));
        let blades: Vec<_> = shown.filter_map(edge).collect();
        self.blades.follow(&blades, &self.tissue);
        let pressing = self.tissue.report().reactions.iter();
        pressing.chain(self.blades.reactions()).cloned().collect()
    }

    /// Compares a past view with the server's corrections, and blends the difference into the present one. `None` if
    /// that view is not kept or has another topology.
    pub fn correct(&mut self, corrections: &Corrections) -> Option<Drift> {
        let topology = self.tissue.topology();
        if corrections.topology_version != topology.version() {
            return None;
        }
        let s = corrections.view_time;
        let known = self.history.at(s, corrections.topology_version)?;
        let mut drift = Drift::default();
        let mut moves = Vec::new();
        for &(node, theirs) in &corrections.nodes {
            if node as usize >= topology.node_count() || topology.is_pinned(node) {
                continue;
            }
            let Some(ours) = known.displacement(node) else {
                continue;
            };
            let difference = Vec3::from(theirs.map(f64::from)) - ours;
            drift.max_m = drift.max_m.max(difference.norm());
            if difference.norm() > DRIFT_TOLERATED_M && self.history.is_news(node, s) {
                moves.push((node, difference * BLEND));
            }
        }
        if !moves.is_empty() {
            drift.nodes = moves.len();
            self.was_corrected = true;
            self.tissue.displace(&moves);
        }
        Some(drift)
    }
}

#[cfg(test)]
mod tests;
