//! The client's replica of the tissue: two shapes over one topology.
//!
//! ```text
//! haptic shape   own tool now, other tools at the common time s   -> contact model
//! view shape     all tools at s                                   -> picture
//! ```
//!
//! The equilibrium is quasi-static, so a shape is a function of topology and contacts. Sites that apply the same
//! operations and solve for the same times have equal shapes. Pure: no thread, no clock.

mod contact_model;
mod history;
mod prefetch;
mod thin_view;
mod view;

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_haptics::ContactModel;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::tool::part_owner;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::{
    Budget, CutOutcome, Model, Reaction, Shape, Solver, SolverState, Successor, Tool, Topology,
};

use crate::tools::{ToolAt, gather};
use contact_model::{contact_model, unusable};
use prefetch::{MadeCut, Retired, cut_checked};

pub(crate) use prefetch::ReadyCut;
pub use prefetch::{CutOrder, CutWorkerEvent, Prefetch, ReplicaError};
pub use thin_view::{ThinCounters, ThinView};
pub use view::{Drift, VIEW_ITERATIONS, VIEW_TOLERANCE, View, ViewCut};

/// Period of the hand's solves, and the CPU time after which a solve starts no further iteration. Iterations within
/// one solve are cheaper than a second solve, which gathers contacts and selects the active set again. The limit is
/// CPU time, because elapsed time would end solves early on a busy machine.
pub const HAPTIC_PERIOD: Span = Span::from_millis(4);

/// Maximum number of iterations; most solves end earlier with steady forces.
pub(crate) const ITERATIONS: usize = 4;

/// Residual at which the hand's solve ends; the force error is then 1 to 2 %. The limit also holds near a
/// single tool: with 3e-2, dragging at 50 mm/s over a thigh had a force error of 6 % instead of 4 %.
pub(crate) const HAPTIC_TOLERANCE: f64 = 2e-2;

/// Budget of a haptic solve; `stop` ends it after [`HAPTIC_PERIOD`] of CPU time.
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

    /// A second side on the same topology.
    pub(crate) fn another(&self, topology: &Topology) -> Self {
        Self {
            shape: Shape::rest(topology),
            solver: self.solver.another(topology),
        }
    }

    /// Continues the state of another side on the topology after a cut.
    pub(crate) fn resume(
        state: SolverState,
        topology: &Topology,
        outcome: &CutOutcome,
        successor: Successor,
    ) -> Self {
        let (solver, shape) = state.resume(topology, outcome, successor);
        Self { shape, solver }
    }

    /// Adopts a cut; the shape must be complete.
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

/// The client's replica of the tissue. Calling order: [`apply`](Self::apply) for every operation in log order; in
/// between [`haptic_step`](Self::haptic_step) at any rate. [`detach_view`](Self::detach_view) moves the view to
/// another thread.
pub struct Replica {
    topology: Arc<Topology>,
    /// `None` for spectators.
    haptic: Option<Box<Side>>,
    /// `None` if it is detached, or for a thin subscriber.
    view: Option<View>,
    /// View of a thin subscriber; `haptic` and `view` are then `None`.
    thin: Option<ThinView>,
    tools: Vec<Tool>,
    others: ExternalWork,
}

impl Replica {
    /// A replica of the uncut tissue; `with_hand` = false suits spectators and saves half the work.
    pub fn new(model: Arc<Model>, with_hand: bool) -> Self {
        let topology = Arc::new(Topology::new(model));
        let view = View::new(&topology);
        Self {
            haptic: with_hand.then(|| Box::new(view.another_side())),
            view: Some(view),
            thin: None,
            topology,
            tools: Vec::new(),
            others: ExternalWork::default(),
        }
    }

    /// A replica for a thin subscriber: it applies cuts and solves nothing.
    pub fn thin(model: Arc<Model>) -> Self {
        let topology = Arc::new(Topology::new(model));
        Self {
            haptic: None,
            view: None,
            thin: Some(ThinView::new(&topology)),
            topology,
            tools: Vec::new(),
            others: ExternalWork::default(),
        }
    }

    /// The view of a thin subscriber; `None` for a full subscriber.
    pub fn thin_view(&self) -> Option<&ThinView> {
        self.thin.as_ref()
    }

    /// The same, mutable.
    pub fn thin_view_mut(&mut self) -> Option<&mut ThinView> {
        self.thin.as_mut()
    }

    /// The topology of both shapes.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// The haptic shape; `None` for spectators.
    pub fn haptic_shape(&self) -> Option<&Shape> {
        self.haptic.as_ref().map(|h| &h.shape)
    }

    /// Relative residual of the latest haptic solve; `None` for spectators.
    pub fn haptic_residual(&self) -> Option<f64> {
        let side = self.haptic.as_ref()?;
        Some(side.solver.report().residual)
    }

    /// Whether forces changed in the latest haptic iteration, or a cut has just been adopted.
    pub(crate) fn is_unsettled(&self) -> bool {
        let solver = self.haptic.as_ref().map(|side| &side.solver);
        solver.is_some_and(|s| s.is_settling() || !s.report().steady)
    }

    /// The view; `None` if it is detached.
    pub fn view(&self) -> Option<&View> {
        self.view.as_ref()
    }

    /// The same, mutable.
    pub fn view_mut(&mut self) -> Option<&mut View> {
        self.view.as_mut()
    }

    /// Takes the view out. The caller must pass it every later cut.
    pub fn detach_view(&mut self) -> Option<View> {
        self.view.take()
    }

    /// The cut worker's state, from the current topology on. `None` without a hand and a view.
    pub fn prefetch(&self) -> Option<Prefetch> {
        let hand = || Some(self.haptic.as_ref()?.solver.follower());
        let follower = self.view.as_ref().map(View::follower).or_else(hand)?;
        Some(Prefetch::new(
            &self.topology,
            follower,
            self.haptic.is_some(),
        ))
    }

    /// Applies an operation now; only a cut changes the tissue. On success version and hash match the operation; on
    /// error nothing has changed. Returns the cut for a detached view.
    pub fn apply(&mut self, operation: &Operation) -> Result<Option<ViewCut>, ReplicaError> {
        // Setting up a cut costs milliseconds; other operations skip it.
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
        let mut prefetch = self.prefetch().ok_or_else(|| ReplicaError::Ended {
            operation: operation.id.to_string(),
        })?;
        Ok(prefetch.make(operation)?.and_then(|made| self.follow(made)))
    }

    /// Adopts a cut now.
    fn follow(&mut self, made: MadeCut) -> Option<ViewCut> {
        self.topology = made.topology;
        if let Some((side, successor)) = self.haptic.as_mut().zip(made.hand) {
            side.solver.prolongate_all(&mut side.shape);
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
    /// latest step; `None` without a hand.
    pub fn capture(&mut self, state: &mut SolverState) -> Option<Vec<Tool>> {
        let side = self.haptic.as_mut()?;
        side.solver.capture(&side.shape, state);
        Some(self.tools.clone())
    }

    /// Tools of the latest haptic step.
    pub fn tools(&self) -> &[Tool] {
        &self.tools
    }

    /// Exchanges topology and hand's side for the prepared next cut of the log. It computes and frees nothing.
    pub fn exchange(&mut self, ready: ReadyCut) -> (Box<ViewCut>, Retired) {
        let topology = std::mem::replace(&mut self.topology, ready.topology);
        let hand = ready.hand.and_then(|side| self.haptic.replace(side));
        (ready.view, Retired { topology, hand })
    }

    /// Moves a tool that touched nothing in the latest solve, without a solve. Returns whether it still touches
    /// nothing.
    pub(crate) fn move_free(&mut self, tool: &ToolAt) -> bool {
        let (Some(side), topology) = (&mut self.haptic, &self.topology) else {
            return false;
        };
        let mut parts = tool.contacts();
        parts.all(|part| side.solver.move_free(topology, &side.shape, &part))
    }

    /// Solves the haptic shape: the `own` tool at its position `now`, the other tools at their common time. Without
    /// contact the model is free. A failed solve gives an unusable model: the force loop counts it and ages the last
    /// one.
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
        if report.rolled_back && presses {
            return unusable(&free);
        }
        let is_own = |r: &&Reaction| me == Some(part_owner(r.tool));
        self.others
            .note(report.reactions.iter().filter(|r| !is_own(r)));
        let parts: Vec<&Reaction> = report.reactions.iter().filter(is_own).collect();
        let model = contact_model(now, version, &parts);
        ContactModel {
            external_work_j: self.others.work_j,
            ..model
        }
    }
}

/// Energy that other hands have put into the tissue.
#[derive(Debug, Default)]
struct ExternalWork {
    /// Net energy, J.
    work_j: f64,
    /// Latest reaction on each of them.
    last: BTreeMap<u32, Reaction>,
}

impl ExternalWork {
    /// Adds the work since the last solve: mean force times displacement, and mean torque times rotation.
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
