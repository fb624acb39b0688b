//! One's own copy of the tissue: two shapes over one topology.
//!
//! ```text
//! haptic shape   own tool now, the others at the moment s that everybody sees   -> contact model
//! view shape     everybody's tool at s, one's own too                           -> what is seen
//! ```
//!
//! Equilibrium is quasi-static, so a shape is a function of topology and contacts: sites that apply
//! the same operations and solve for the same moments see the same. Pure: no thread, no clock.

use std::sync::Arc;

use palpate_haptics::ContactModel;
use palpate_protocol::datagram::Corrections;
use palpate_protocol::operation::Operation;
use palpate_protocol::{ClientTime, ServerTime};
use palpate_tissue::{
    Budget, CutOutcome, Model, Reaction, Shape, Solver, StepReport, Successor, Tool, Topology, Vec3,
};

use crate::ahead::{Ahead, ReadyCut, ReplicaError};
use crate::history::History;
use crate::roster::ToolAt;

/// How far from the solved position the force law is believed, m: half a metre per second for 16
/// ms, four periods of the solver. Smaller lets the force fade in fast strokes, larger believes a
/// linear law where the tissue is none.
pub const MODEL_RADIUS_M: f64 = 8e-3;

/// Damping of the contact in parts of its normal stiffness, s: 1 ms takes the ring out of a hand
/// against tissue and is not felt.
const DAMPING_S: f64 = 1e-3;

/// Damping of the contact at most, N·s/m: well below what a 0.1 kg handle at 1 kHz turns into
/// oscillation (2 m / T is 200).
const DAMPING_MAX_NS_PER_M: f64 = 2.0;

/// A node this far from where the server has it is corrected, m; below it sites are alike.
pub const DRIFT_TOLERATED_M: f64 = 0.05e-3;

/// Part of the difference that a correction takes away at once. The equilibrium does the rest; more
/// would show as a twitch.
const BLEND: f64 = 0.3;

/// Iterations at most; time ends most solves.
pub const ITERATIONS: usize = 4;

/// Residual at which the hand's solve ends: the force is then within a few percent.
pub const HAPTIC_TOLERANCE: f64 = 3e-2;

/// Residual at which the hand's solve ends while the hand rests: time is there, and a force that
/// stands still is felt for what it is.
pub const RESTING_TOLERANCE: f64 = 5e-3;

/// A hand slower than this rests, m/s.
pub const RESTING_M_S: f64 = 0.005;

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

struct Side {
    shape: Shape,
    solver: Solver,
}

impl Side {
    fn new(topology: &Topology) -> Self {
        Self {
            shape: Shape::rest(topology),
            solver: Solver::new(topology),
        }
    }

    /// A second side of the same topology.
    fn another(&self, topology: &Topology) -> Self {
        Self {
            shape: Shape::rest(topology),
            solver: self.solver.another(topology),
        }
    }

    /// Takes a cut over.
    fn succeed(&mut self, topology: &Topology, outcome: &CutOutcome, successor: Successor) {
        self.shape.follow(topology, outcome);
        self.solver.succeed(topology, successor);
    }
}

/// One's own copy of the tissue.
///
/// Calling order: [`apply`](Self::apply) every operation in the order of the log; between them
/// [`haptic_step`](Self::haptic_step) and [`view_step`](Self::view_step) as often as wanted, the
/// latter with ascending moments.
pub struct Replica {
    topology: Arc<Topology>,
    /// `None` for who only looks.
    haptic: Option<Side>,
    view: Side,
    /// A cut that the view has still to follow. It waits for the next view, so that the hand, whose
    /// model fades within a few ticks, is served first.
    unseen: Option<(CutOutcome, Successor)>,
    history: History,
    was_corrected: bool,
    tools: Vec<Tool>,
}

impl Replica {
    /// The uncut tissue; `with_hand` = false is for spectators and saves half the work.
    pub fn new(model: Arc<Model>, with_hand: bool) -> Self {
        let topology = Arc::new(Topology::new(model));
        let view = Side::new(&topology);
        Self {
            haptic: with_hand.then(|| view.another(&topology)),
            view,
            topology,
            unseen: None,
            history: History::default(),
            was_corrected: false,
            tools: Vec::new(),
        }
    }

    /// The topology of both shapes.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// What is seen.
    pub fn view_shape(&self) -> &Shape {
        &self.view.shape
    }

    /// What the hand feels; `None` for who only looks.
    pub fn haptic_shape(&self) -> Option<&Shape> {
        self.haptic.as_ref().map(|h| &h.shape)
    }

    /// What makes cuts ahead of this copy, from the topology of now on.
    pub fn ahead(&mut self) -> Ahead {
        // The view has to be of now for what follows it.
        self.show_cut();
        let follower = self.view.solver.follower();
        Ahead::new(&self.topology, follower, self.haptic.is_some())
    }

    /// Applies an operation here and now; only a cut changes anything. Afterwards version and hash
    /// are the operation's, or it is an error and nothing has changed.
    pub fn apply(&mut self, operation: &Operation) -> Result<(), ReplicaError> {
        if let Some(ready) = self.ahead().make(operation)? {
            self.take(ready);
        }
        Ok(())
    }

    /// Takes over a cut that [`ahead`](Self::ahead) has made, the next one of the log.
    pub fn take(&mut self, ready: ReadyCut) {
        self.show_cut();
        self.topology = ready.topology;
        if let Some((side, successor)) = self.haptic.as_mut().zip(ready.haptic) {
            side.solver.pour(&mut side.shape);
            side.succeed(&self.topology, &ready.outcome, successor);
        }
        self.unseen = Some((ready.outcome, ready.view));
        self.history.clear();
    }

    /// Solves what the hand feels: one's `own` tool where it is `now`, the others where everybody
    /// sees them. A tool that does not press gives a model without contact. A solve that was thrown
    /// away gives a model that is not usable: the force loop counts it and lets the last one age.
    pub fn haptic_step(
        &mut self,
        now: ClientTime,
        own: Option<&ToolAt>,
        others: &[ToolAt],
        budget: Budget<'_>,
    ) -> ContactModel {
        let version = self.topology.version();
        let free = ContactModel::free_at(now, version);
        let Some(side) = &mut self.haptic else {
            return free;
        };
        let me = own.map(|t| t.participant);
        let others = others.iter().filter(|t| Some(t.participant) != me);
        gather(&mut self.tools, own.into_iter().chain(others));
        let report = side
            .solver
            .step(&self.topology, &mut side.shape, &self.tools, budget);
        let id = own.and_then(ToolAt::contact).map(|t| t.id);
        if report.fell_back && id.is_some() {
            return unusable(free);
        }
        report
            .reactions
            .iter()
            .find(|r| Some(r.tool) == id)
            .map_or(free, |r| contact_model(now, version, r))
    }

    /// Solves what everybody sees at the moment `s`.
    pub fn view_step(
        &mut self,
        s: ServerTime,
        tools: &[ToolAt],
        budget: Budget<'_>,
    ) -> &StepReport {
        self.show_cut();
        gather(&mut self.tools, tools.iter());
        let side = &mut self.view;
        side.solver
            .step(&self.topology, &mut side.shape, &self.tools, budget);
        let changed = self.was_corrected || side.solver.report().visits[0] > 0;
        self.was_corrected = false;
        self.history
            .push(s, self.topology.version(), &side.shape, changed);
        side.solver.report()
    }

    fn show_cut(&mut self) {
        if let Some((outcome, successor)) = self.unseen.take() {
            self.view.succeed(&self.topology, &outcome, successor);
        }
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
                self.view.shape.displacement[node as usize] += difference * BLEND;
                disturbed.push(node);
            }
        }
        if !disturbed.is_empty() {
            drift.nodes = disturbed.len();
            self.was_corrected = true;
            let view = &mut self.view;
            view.solver.disturb(&view.shape, &disturbed);
        }
        Some(drift)
    }
}

fn gather<'a>(into: &mut Vec<Tool>, tools: impl Iterator<Item = &'a ToolAt>) {
    into.clear();
    into.extend(tools.filter_map(ToolAt::contact));
}

/// What the force loop has to know of a reaction until the next solve. The linear law stands where
/// the solver computed the force: at the tool, unless that jumped and the proxy is still on its way.
fn contact_model(now: ClientTime, topology_version: u32, r: &Reaction) -> ContactModel {
    if r.contacts == 0 || (r.normal.norm() - 1.0).abs() > 1e-6 {
        return ContactModel::free_at(now, topology_version);
    }
    let along = r.normal.dot(&(r.stiffness * r.normal)).max(0.0);
    ContactModel {
        topology_version,
        solved_at: now,
        x0: r.at,
        f0: r.force,
        stiffness: r.stiffness,
        damping: (DAMPING_S * along).min(DAMPING_MAX_NS_PER_M),
        normal: r.normal,
        mu_static: r.friction_static,
        mu_dynamic: r.friction_dynamic.min(r.friction_static),
        radius: MODEL_RADIUS_M,
        in_contact: true,
    }
}

/// A model that the force loop does not take.
fn unusable(free: ContactModel) -> ContactModel {
    ContactModel {
        f0: Vec3::repeat(f64::NAN),
        ..free
    }
}

#[cfg(test)]
mod tests;
