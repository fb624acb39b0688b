//! One's own copy of the tissue: two shapes over one topology.
//!
//! ```text
//! haptic shape   own tool now, the others at the moment s that everybody sees   -> contact model
//! view shape     everybody's tool at s, one's own too                           -> what is seen
//! ```
//!
//! Equilibrium is quasi-static, so a shape is a function of topology and contacts: sites that apply
//! the same operations and solve for the same moments see the same. Pure: no thread, no clock.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_haptics::ContactModel;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::tool::part_owner;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::{
    Budget, CutOutcome, Model, Reaction, Shape, Solver, SolverState, Successor, Tool, Topology,
};

use crate::ahead::{Ahead, MadeCut, ReadyCut, ReplicaError, Retired, cut_checked};
use crate::felt::{contact_model, unusable};
use crate::roster::{ToolAt, gather};
use crate::thin::ThinView;
use crate::view::{View, ViewCut};

/// From one solve of the hand's tissue to the next, and the CPU time after which a solve begins no further iteration.
/// Iterations are better made within a solve than in two: each solve gathers contacts and selects the active set anew. The
/// limit is CPU time, because on a busy machine elapsed time would end solves before they converge.
pub const HAPTIC_PERIOD: Span = Span::from_millis(4);

/// Iterations at most; most solves end when the forces are steady.
pub(crate) const ITERATIONS: usize = 4;

/// Residual at which the hand's solve ends: the force is then within a percent or two. Less is not asked for of what is
/// near a tool alone. With 3e-2 a line that was dragged at 50 mm/s over a thigh felt a force that was 6 % off instead
/// of 4 %.
pub(crate) const HAPTIC_TOLERANCE: f64 = 2e-2;

/// The budget of a solve of what a hand feels; `stop` ends it after [`HAPTIC_PERIOD`] of CPU time.
pub fn hand_budget(stop: &mut dyn FnMut() -> bool) -> Budget<'_> {
    Budget {
        near: true,
        iterations: ITERATIONS,
        tolerance: HAPTIC_TOLERANCE,
        stop: Some(stop),
    }
}

/// One shape of the tissue and its solver.
pub(crate) struct Side {
    pub(crate) shape: Shape,
    pub(crate) solver: Solver,
}

impl Side {
    pub(crate) fn new(topology: &Topology) -> Self {
        Self {
            shape: Shape::rest(topology),
            solver: Solver::new(topology),
        }
    }

    /// A second side of the same topology.
    pub(crate) fn another(&self, topology: &Topology) -> Self {
        Self {
            shape: Shape::rest(topology),
            solver: self.solver.another(topology),
        }
    }

    /// Continues the state of another side on the topology as a cut left it.
    pub(crate) fn resume(
        state: SolverState,
        topology: &Topology,
        outcome: &CutOutcome,
        successor: Successor,
    ) -> Self {
        let (solver, shape) = state.resume(topology, outcome, successor);
        Self { shape, solver }
    }

    /// Takes a cut over; the shape must be whole.
    pub(crate) fn succeed(
        &mut self,
        topology: &Topology,
        outcome: &CutOutcome,
        successor: Successor,
    ) {
        self.shape.follow(topology, outcome);
        self.solver.succeed(topology, successor);
    }
}

/// One's own copy of the tissue.
///
/// Calling order: [`apply`](Self::apply) every operation in the order of the log; between them
/// [`haptic_step`](Self::haptic_step) as often as wanted. The view may be taken away with
/// [`detach_view`](Self::detach_view), to be solved elsewhere.
pub struct Replica {
    topology: Arc<Topology>,
    /// `None` for who only looks.
    haptic: Option<Box<Side>>,
    /// `None` when it is elsewhere, or for who is thin.
    view: Option<View>,
    /// What is shown to who has no tissue that is computed; then nothing of the above is there.
    thin: Option<ThinView>,
    tools: Vec<Tool>,
    others: Others,
}

impl Replica {
    /// The uncut tissue; `with_hand` = false is for spectators and saves half the work.
    pub fn new(model: Arc<Model>, with_hand: bool) -> Self {
        let topology = Arc::new(Topology::new(model));
        let view = View::new(&topology);
        Self {
            haptic: with_hand.then(|| Box::new(view.another_side())),
            view: Some(view),
            thin: None,
            topology,
            tools: Vec::new(),
            others: Others::default(),
        }
    }

    /// The uncut tissue for a thin subscriber: cuts are made, nothing is solved.
    pub fn thin(model: Arc<Model>) -> Self {
        let topology = Arc::new(Topology::new(model));
        Self {
            haptic: None,
            view: None,
            thin: Some(ThinView::new(&topology)),
            topology,
            tools: Vec::new(),
            others: Others::default(),
        }
    }

    /// What a thin subscriber shows; `None` for who computes the tissue.
    pub fn thin_view(&self) -> Option<&ThinView> {
        self.thin.as_ref()
    }

    /// The same, to tell it news.
    pub fn thin_view_mut(&mut self) -> Option<&mut ThinView> {
        self.thin.as_mut()
    }

    /// The topology of both shapes.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// What the hand feels; `None` for who only looks.
    pub fn haptic_shape(&self) -> Option<&Shape> {
        self.haptic.as_ref().map(|h| &h.shape)
    }

    /// Bricks that the hand's last step visited: what it cost, whatever the machine.
    pub fn haptic_bricks(&self) -> Option<usize> {
        self.haptic.as_ref().map(|h| h.solver.report().visits[0])
    }

    /// Relative residual of the latest solve of what the hand feels; `None` for who only looks.
    pub fn haptic_residual(&self) -> Option<f64> {
        let side = self.haptic.as_ref()?;
        Some(side.solver.report().residual)
    }

    /// Whether forces changed in the latest iteration of what the hand feels, or a cut has just changed it.
    pub(crate) fn is_unsettled(&self) -> bool {
        let solver = self.haptic.as_ref().map(|side| &side.solver);
        solver.is_some_and(|s| s.is_settling() || !s.report().steady)
    }

    /// What is seen; `None` when it is elsewhere.
    pub fn view(&self) -> Option<&View> {
        self.view.as_ref()
    }

    /// The same, to solve or correct it.
    pub fn view_mut(&mut self) -> Option<&mut View> {
        self.view.as_mut()
    }

    /// Takes the view out. Whoever holds it must give it every cut from now on.
    pub fn detach_view(&mut self) -> Option<View> {
        self.view.take()
    }

    /// What makes cuts ahead of this copy, from the topology of now on. `None` when neither a hand nor a
    /// view is here that knows it.
    pub fn ahead(&self) -> Option<Ahead> {
        let hand = || Some(self.haptic.as_ref()?.solver.follower());
        let follower = self.view.as_ref().map(View::follower).or_else(hand)?;
        Some(Ahead::new(&self.topology, follower, self.haptic.is_some()))
    }

    /// Applies an operation here and now; only a cut changes anything. Afterwards version and hash
    /// are the operation's, or it is an error and nothing has changed. What a view elsewhere has to take
    /// over is given back.
    pub fn apply(&mut self, operation: &Operation) -> Result<Option<ViewCut>, ReplicaError> {
        // What makes cuts costs milliseconds to set up: not for who joins or leaves.
        if !matches!(operation.kind, OperationKind::Cut(_)) {
            return Ok(None);
        }
        if let Some(thin) = &mut self.thin {
            let outcome = cut_checked(&mut self.topology, operation)?;
            if let Some(outcome) = outcome {
                thin.follow(&self.topology, &outcome);
            }
            return Ok(None);
        }
        let mut ahead = self.ahead().ok_or_else(|| ReplicaError::Ended {
            operation: operation.id.to_string(),
        })?;
        Ok(ahead.make(operation)?.and_then(|made| self.follow(made)))
    }

    /// Follows a cut here and now.
    fn follow(&mut self, made: MadeCut) -> Option<ViewCut> {
        self.topology = made.topology;
        if let Some((side, successor)) = self.haptic.as_mut().zip(made.hand) {
            side.solver.pour(&mut side.shape);
            side.succeed(&self.topology, &made.outcome, successor);
        }
        let cut = ViewCut {
            topology: Arc::clone(&self.topology),
            outcome: made.outcome,
            successor: made.view,
        };
        match &mut self.view {
            Some(view) => {
                view.take(cut);
                None
            }
            None => Some(cut),
        }
    }

    /// Copies the state of the hand's side, to be continued on the topology of the next cut. Returns the tools of its
    /// last step; `None` without a hand.
    pub fn capture(&mut self, state: &mut SolverState) -> Option<Vec<Tool>> {
        let side = self.haptic.as_mut()?;
        side.solver.capture(&side.shape, state);
        Some(self.tools.clone())
    }

    /// The tools of the hand's last step.
    pub fn tools(&self) -> &[Tool] {
        &self.tools
    }

    /// Exchanges topology and hand's side for those of the next cut of the log, as [`ahead`](Self::ahead) has prepared
    /// them. It computes and frees nothing.
    pub fn exchange(&mut self, ready: ReadyCut) -> (Box<ViewCut>, Retired) {
        let topology = std::mem::replace(&mut self.topology, ready.topology);
        let hand = ready.hand.and_then(|side| self.haptic.replace(side));
        (ready.view, Retired { topology, hand })
    }

    /// Moves a tool that touched nothing in the latest solve, without another one. Returns whether it touches nothing now.
    pub(crate) fn move_free(&mut self, tool: &ToolAt) -> bool {
        let (Some(side), topology) = (&mut self.haptic, &self.topology) else {
            return false;
        };
        let mut parts = tool.contacts();
        parts.all(|part| side.solver.move_free(topology, &side.shape, &part))
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
        let presses = own.is_some_and(|own| own.contacts().next().is_some());
        if report.fell_back && presses {
            return unusable(&free);
        }
        let is_own = |r: &&Reaction| me == Some(part_owner(r.tool));
        self.others
            .note(report.reactions.iter().filter(|r| !is_own(r)));
        let parts: Vec<&Reaction> = report.reactions.iter().filter(is_own).collect();
        let model = contact_model(now, version, &parts);
        ContactModel {
            others_j: self.others.work_j,
            ..model
        }
    }
}

/// What other hands have put into the tissue.
#[derive(Debug, Default)]
struct Others {
    /// Less what they have got back, J.
    work_j: f64,
    /// What was felt at each of them.
    last: BTreeMap<u32, Reaction>,
}

impl Others {
    /// Adds what they did since the last solve: the mean of the two forces over the way between, and of the two
    /// torques over the turn.
    fn note<'a>(&mut self, reactions: impl Iterator<Item = &'a Reaction>) {
        let mut now = BTreeMap::new();
        for r in reactions {
            if let Some(last) = self.last.get(&r.tool) {
                let turned = (r.turn * last.turn.inverse()).scaled_axis();
                self.work_j -= 0.5 * (last.force + r.force).dot(&(r.at - last.at));
                self.work_j -= 0.5 * (last.torque + r.torque).dot(&turned);
            }
            now.insert(r.tool, r.clone());
        }
        self.last = now;
    }
}

#[cfg(test)]
mod tests;
