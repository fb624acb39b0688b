//! The client's replica of the tissue: two shapes over one topology.
//!
//! ```text
//! haptic shape   own tool as predicted, other tools at the common time s   -> contact model
//! view shape     all tools at s                                            -> picture
//! ```
//!
//! The equilibrium is quasi-static, so a shape is a function of topology and contacts. Sites that apply the same
//! operations and solve for the same times have equal shapes. Pure: no thread, no clock.

mod contact_model;
mod cutting_force;
mod history;
mod prefetch;
mod shaft_model;
mod thin_view;
mod view;

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_haptics::ContactModel;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::tool::part_owner;
use palpate_protocol::{ClientTime, Span};
use palpate_tissue::snapshot::restore;
use palpate_tissue::{
    Budget, CutHistory, CutOutcome, Model, PreparedCut, Reaction, Retired, Shape, Tissue, Tool,
    Topology,
};

use crate::tools::{ToolAt, gather, tissue_stroke};
use contact_model::{contact_model, unusable};
use cutting_force::CuttingForce;
use prefetch::change_checked;
use shaft_model::hold_shaft;

pub use prefetch::{CutOrder, MadeCut, Prefetch, ReplicaError};
pub use thin_view::{ThinCounters, ThinView};
pub use view::{Drift, VIEW_ITERATIONS, VIEW_TOLERANCE, View};

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

/// The tissue under a hand; a spectator has none, and keeps the topology.
pub(crate) enum HandTissue {
    Present(Box<Tissue>),
    Absent(Arc<Topology>),
}

impl HandTissue {
    fn topology(&self) -> &Arc<Topology> {
        match self {
            Self::Present(tissue) => tissue.topology(),
            Self::Absent(topology) => topology,
        }
    }

    fn tissue(&self) -> Option<&Tissue> {
        match self {
            Self::Present(tissue) => Some(tissue),
            Self::Absent(_) => None,
        }
    }

    fn tissue_mut(&mut self) -> Option<&mut Tissue> {
        match self {
            Self::Present(tissue) => Some(tissue),
            Self::Absent(_) => None,
        }
    }
}

/// View and cuts of a thin subscriber.
struct Thin {
    view: ThinView,
    history: CutHistory,
}

/// The client's replica of the tissue. Calling order: [`apply`](Self::apply) for every operation in log order; in
/// between [`haptic_step`](Self::haptic_step) at any rate. [`detach_view`](Self::detach_view) moves the view to
/// another thread.
pub struct Replica {
    haptic: HandTissue,
    with_hand: bool,
    /// `None` if it is detached, during a replay, or for a thin subscriber.
    view: Option<View>,
    /// A thin subscriber has neither a hand nor a `view`.
    thin: Option<Thin>,
    /// Topology and strokes ahead of the shapes, while the log before the join is replayed.
    replay: Option<(Arc<Topology>, CutHistory)>,
    tools: Vec<Tool>,
    others: ExternalWork,
    cutting: CuttingForce,
}

impl Replica {
    /// A replica of the uncut tissue; `with_hand` = false suits spectators and saves half the work.
    pub fn new(model: Arc<Model>, with_hand: bool) -> Self {
        let mut replica = Self::before_replay(model, with_hand);
        replica.end_replay();
        replica
    }

    /// A replica that receives a log with cuts before it has shapes: solvers take most of a second to build. Snapshot
    /// and operations follow, then [`end_replay`](Self::end_replay).
    pub(crate) fn before_replay(model: Arc<Model>, with_hand: bool) -> Self {
        let topology = Arc::new(Topology::new(model));
        let history = CutHistory::new(Arc::clone(&topology));
        Self {
            haptic: HandTissue::Absent(Arc::clone(&topology)),
            with_hand,
            view: None,
            thin: None,
            replay: Some((topology, history)),
            tools: Vec::new(),
            others: ExternalWork::default(),
            cutting: CuttingForce::default(),
        }
    }

    /// A replica for a thin subscriber: it applies cuts and solves nothing.
    pub fn thin(model: Arc<Model>) -> Self {
        let topology = Arc::new(Topology::new(model));
        Self {
            view: None,
            thin: Some(Thin {
                view: ThinView::new(&topology),
                history: CutHistory::new(Arc::clone(&topology)),
            }),
            haptic: HandTissue::Absent(topology),
            with_hand: false,
            replay: None,
            tools: Vec::new(),
            others: ExternalWork::default(),
            cutting: CuttingForce::default(),
        }
    }

    /// The view of a thin subscriber; `None` for a full subscriber.
    pub fn thin_view(&self) -> Option<&ThinView> {
        self.thin.as_ref().map(|thin| &thin.view)
    }

    /// The same, mutable.
    pub fn thin_view_mut(&mut self) -> Option<&mut ThinView> {
        self.thin.as_mut().map(|thin| &mut thin.view)
    }

    /// The newest topology.
    pub fn topology(&self) -> &Arc<Topology> {
        let ahead = self.replay.as_ref().map(|(topology, _)| topology);
        ahead.unwrap_or_else(|| self.haptic.topology())
    }

    /// Whether it has a hand, or will have one after the replay.
    pub(crate) fn has_hand(&self) -> bool {
        self.with_hand
    }

    /// The haptic shape; `None` for spectators and during a replay.
    pub fn haptic_shape(&self) -> Option<&Shape> {
        self.haptic.tissue().map(Tissue::shape)
    }

    /// Relative residual of the latest haptic solve; `None` for spectators.
    pub fn haptic_residual(&self) -> Option<f64> {
        Some(self.haptic.tissue()?.report().residual)
    }

    /// Whether forces changed in the latest haptic iteration, or a cut has just been adopted.
    pub(crate) fn is_unsettled(&self) -> bool {
        let tissue = self.haptic.tissue();
        tissue.is_some_and(|t| t.is_settling() || !t.report().steady)
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
        let hand = self.haptic.tissue();
        let view = self.view.as_ref().map(View::preparer);
        let preparer = view.or_else(|| Some(hand?.preparer()))?;
        Some(Prefetch::new(preparer, hand.is_some()))
    }

    /// Applies an operation now; only a cut, an undo, a redo or a reset changes the tissue. On success version and hash
    /// match the operation; on error nothing has changed. Returns the cut for a detached view.
    pub fn apply(&mut self, operation: &Operation) -> Result<Option<PreparedCut>, ReplicaError> {
        // Setting up a cut costs milliseconds; other operations skip it.
        if !operation.kind.changes_topology() {
            return Ok(None);
        }
        if let (Some(Thin { view, history }), HandTissue::Absent(topology)) =
            (&mut self.thin, &mut self.haptic)
        {
            let outcome = repeat_change(topology, history, operation)?;
            if let Some(outcome) = outcome {
                view.follow(topology, &outcome);
            }
            return Ok(None);
        }
        let mut prefetch = self.prefetch().ok_or_else(|| ReplicaError::Ended {
            operation: operation.id.to_string(),
        })?;
        let Some(made) = prefetch.make(operation)? else {
            return Ok(None);
        };
        let (cut, _) = self.adopt(made);
        let Some(view) = &mut self.view else {
            return Ok(Some(*cut));
        };
        view.take(*cut);
        Ok(None)
    }

    /// The strokes of the newest topology; `None` while the view is detached.
    pub fn history(&self) -> Option<&CutHistory> {
        if let Some((_, history)) = &self.replay {
            return Some(history);
        }
        let thin = self.thin.as_ref().map(|thin| &thin.history);
        thin.or_else(|| Some(self.view.as_ref()?.tissue().history()))
    }

    /// Restores a snapshot of the log before the join, in place of all earlier cuts. [`end_replay`](Self::end_replay)
    /// follows.
    pub(crate) fn restore(&mut self, snapshot: &[u8]) -> Result<(), ReplicaError> {
        let refused = |why: String| ReplicaError::Snapshot(why);
        let history = (self.history())
            .ok_or_else(|| refused("came after the view was detached".to_owned()))?;
        let restored = restore(history.uncut(), snapshot);
        let (topology, history) = restored.map_err(|e| refused(e.to_string()))?;
        if let Some(thin) = &mut self.thin {
            thin.view.restore(&topology);
            thin.history = history;
            self.haptic = HandTissue::Absent(topology);
        } else {
            self.replay = Some((topology, history));
        }
        Ok(())
    }

    /// Applies an operation of the log before the join to the topology alone. [`end_replay`](Self::end_replay) follows.
    pub(crate) fn replay(&mut self, operation: &Operation) -> Result<(), ReplicaError> {
        if operation.kind.changes_topology() && self.replay.is_none() {
            let tissue = self.view.as_ref().map(View::tissue);
            self.replay = tissue.map(|t| (Arc::clone(t.topology()), t.history().clone()));
        }
        match &mut self.replay {
            Some((topology, history)) => repeat_change(topology, history, operation).map(drop),
            None => self.apply(operation).map(drop),
        }
    }

    /// Builds both shapes of the replayed topology, at rest.
    pub(crate) fn end_replay(&mut self) {
        let Some((topology, history)) = self.replay.take() else {
            return;
        };
        let view = View::new(Tissue::with_history(topology, history));
        self.haptic = if self.with_hand {
            HandTissue::Present(Box::new(view.another_tissue()))
        } else {
            HandTissue::Absent(Arc::clone(view.topology()))
        };
        self.view = Some(view);
    }

    /// Adopts the next cut of the log. Returns it for the view, and memory to free elsewhere.
    pub fn adopt(&mut self, made: MadeCut) -> (Box<PreparedCut>, Option<Retired>) {
        let retired = match (&mut self.haptic, made.hand) {
            (HandTissue::Present(tissue), Some(hand)) => Some(tissue.succeed(hand)),
            (haptic, _) => {
                *haptic = HandTissue::Absent(Arc::clone(made.view.topology()));
                None
            }
        };
        (made.view, retired)
    }

    /// Moves a tool that touched nothing in the latest solve, without a solve. Returns whether it still touches
    /// nothing; a cutting blade may meet tissue anywhere.
    pub(crate) fn move_free(&mut self, tool: &ToolAt) -> bool {
        if tool.is_cutting() {
            return false;
        }
        let Some(tissue) = self.haptic.tissue_mut() else {
            return false;
        };
        let mut parts = tool.contacts();
        parts.all(|part| tissue.move_free(&part))
    }

    /// Solves the haptic shape: the `own` tool where it is predicted to be, the other tools at their common time. Without
    /// contact the model is free. A failed solve gives an unusable model: the force loop counts it and ages the last
    /// one.
    pub fn haptic_step(
        &mut self,
        now: ClientTime,
        own: Option<&ToolAt>,
        others: &[ToolAt],
        budget: Budget<'_>,
    ) -> ContactModel {
        let version = self.topology().version();
        let free = ContactModel {
            is_inserted: own.is_some_and(ToolAt::is_inserted),
            was_cutting: own.and_then(ToolAt::blade_cuts),
            external_work_j: self.others.work_j,
            ..ContactModel::free_at(now, version)
        };
        let Some(tissue) = self.haptic.tissue_mut() else {
            return ContactModel {
                is_absent: true,
                ..free
            };
        };
        let me = own.map(|t| t.participant);
        let others = others.iter().filter(|t| Some(t.participant) != me);
        gather(&mut self.tools, own.into_iter().chain(others));
        // The own needle enters here first; the state of others comes with their motion.
        for tool in &mut self.tools {
            if let Some(needle) = &mut tool.needle {
                needle.decides = me == Some(part_owner(tool.id));
            }
        }
        let report = tissue.step(&self.tools, budget);
        let presses = own.is_some_and(|own| own.contacts().next().is_some());
        if report.rolled_back && presses {
            return unusable(&free);
        }
        let is_own = |r: &&Reaction| me == Some(part_owner(r.tool));
        self.others
            .note(report.reactions.iter().filter(|r| !is_own(r)));
        let parts: Vec<&Reaction> = report.reactions.iter().filter(is_own).collect();
        let mut model = contact_model(now, version, &parts);
        if let Some((needle, shaft)) = parts.iter().find_map(|r| Some((r, r.shaft.as_ref()?))) {
            hold_shaft(&mut model, needle, shaft);
        }
        model.is_inserted = parts.iter().any(|r| r.is_inserted);
        if let Some(own) = own {
            self.cutting.add_to(&mut model, tissue, own);
        }
        ContactModel {
            external_work_j: self.others.work_j,
            was_cutting: free.was_cutting,
            is_absent: own.is_none(),
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

/// Makes the change of an operation on a topology without a shape; `None` if it changes no topology. The version before
/// and the hash after it are checked.
pub fn repeat_change(
    topology: &mut Arc<Topology>,
    history: &mut CutHistory,
    operation: &Operation,
) -> Result<Option<CutOutcome>, ReplicaError> {
    change_checked(topology.version(), operation, |change| {
        let outcome = match change {
            OperationKind::Cut(part) => {
                Some(history.cut(topology, tissue_stroke(operation.author, part)))
            }
            OperationKind::Undone => history.undo(topology).map(Ok),
            OperationKind::Redone => history.redo(topology),
            OperationKind::Reset => Some(Ok(history.reset(topology))),
            _ => None,
        };
        outcome.map(|outcome| outcome.map(|outcome| (Arc::clone(topology), outcome)))
    })
}

#[cfg(test)]
mod proxy_tests;
#[cfg(test)]
mod tests;
