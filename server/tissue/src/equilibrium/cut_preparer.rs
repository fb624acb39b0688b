//! A cut, an undo, a redo or a reset, prepared outside the solver thread.
//!
//! A [`CutPreparer`] cuts the topology and computes the change of bricks and levels on another thread. A [`PreparedCut`]
//! then brings any tissue of that topology up to date, in a time that depends on the changed faces alone.

use std::sync::Arc;

use rayon::prelude::*;

use super::chain::Chain;
use super::construction::Construction;
use super::contact_smoother::ContactSmoother;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, own_stiffness};
use super::hierarchy::Hierarchy;
use super::hierarchy_change::HierarchyChange;
use super::journal::Journal;
use super::reference_state::ReferenceState;
use super::solver::Solver;
use super::weight::weights;
use crate::contact::{SurfaceIndex, SurfaceTree, TreeRoom};
use crate::cut::{CutError, CutOutcome, StrokePart};
use crate::cut_history::{CutHistory, Follower};
use crate::{Shape, Topology};

/// Makes cuts ahead of the tissue, on another thread. It costs about 100 bytes per node.
#[derive(Clone)]
pub struct CutPreparer {
    topology: Arc<Topology>,
    history: CutHistory,
    pub(super) hierarchy: Hierarchy,
    pub(super) construction: Construction,
    journal: Journal,
    room: TreeRoom,
    reference_state: Option<Arc<ReferenceState>>,
}

/// Brings a hierarchy through an undo, a redo or a reset.
struct Replay<'a> {
    hierarchy: &'a mut Hierarchy,
    construction: &'a mut Construction,
    journal: &'a mut Journal,
    /// All changes so far.
    changes: Chain<HierarchyChange>,
    /// Parts cut so far.
    cuts: usize,
    /// Nodes and cuts up to the stroke that is taken back.
    reached: Option<(usize, usize)>,
    is_rebuilt: bool,
}

impl Replay<'_> {
    /// All changes as one; `None` if the levels are new.
    fn change(self) -> Option<HierarchyChange> {
        let mut change = self.changes.joined()?;
        if let Some((nodes, cuts)) = self.reached {
            change.stays = nodes;
            change.outcomes.drain(..cuts);
        }
        Some(change)
    }
}

impl Follower for Replay<'_> {
    fn rewind(&mut self, topology: &Topology, parts: usize) {
        if let Some(way) = self.journal.take(parts, self.hierarchy) {
            let change = self.hierarchy.go_back(self.construction, topology, way);
            self.changes.push(change);
        } else {
            *self.hierarchy = Hierarchy::new(topology);
            *self.construction = Construction::of(topology, self.hierarchy);
            *self.journal = Journal::new(parts);
            self.is_rebuilt = true;
        }
    }

    fn reach(&mut self, topology: &Topology) {
        self.reached = Some((topology.node_count(), self.cuts));
    }

    fn advance(&mut self, topology: &Topology, parts: usize, outcome: CutOutcome) {
        let outcome = Arc::new(outcome);
        let follow = Hierarchy::follow;
        let (change, way) = follow(self.hierarchy, self.construction, topology, &outcome);
        self.journal.push(parts, way);
        if !self.is_rebuilt {
            self.changes.push(change);
            self.cuts += 1;
        }
    }
}

/// A cut that a [`CutPreparer`] has made, for one [`Tissue`](crate::Tissue) to adopt.
pub struct PreparedCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) history: CutHistory,
    pub(crate) outcome: Arc<CutOutcome>,
    pub(super) levels: Levels,
    /// Tree of the surface, if that of a tissue keeps too much memory.
    tree: Option<SurfaceTree>,
    reference_state: Option<Arc<ReferenceState>>,
}

/// A cut of the newest topology that bricks and levels do not follow yet: versions and hashes are known in a quarter of the
/// time. It is finished when dropped.
#[must_use]
pub struct TopologyCut<'a> {
    preparer: &'a mut CutPreparer,
    rest: Option<Rest>,
}

/// The work that a tissue needs before it can adopt a cut.
enum Rest {
    Levels(CutOutcome),
    /// Levels follow an undo, a redo or a reset with the topology.
    Nothing(Box<PreparedCut>),
}

/// Bricks and levels after a cut.
pub(super) enum Levels {
    /// Changed around the faces that were opened or closed.
    Changed(Arc<HierarchyChange>),
    /// Built from scratch after an undo beyond the start of the journal.
    Rebuilt(Box<Rebuilt>),
}

pub(super) struct Rebuilt {
    hierarchy: Hierarchy,
    fine: FineLevel,
    coarse: Multigrid,
    index: SurfaceIndex,
}

/// Memory that a cut replaced. Freeing it can take milliseconds.
pub struct Retired {
    _topology: Arc<Topology>,
    _history: CutHistory,
    _levels: Levels,
    _tree: Option<SurfaceTree>,
}

impl PreparedCut {
    /// The topology after the cut.
    pub fn topology(&self) -> &Arc<Topology> {
        &self.topology
    }
}

impl CutPreparer {
    /// The newest topology.
    pub fn topology(&self) -> &Arc<Topology> {
        &self.topology
    }

    /// The strokes of the newest topology.
    pub fn history(&self) -> &CutHistory {
        &self.history
    }

    /// Makes the next cut: a whole stroke or a part of one. On an error nothing changes.
    pub fn prepare(&mut self, part: impl Into<StrokePart>) -> Result<PreparedCut, CutError> {
        self.cut(part).map(TopologyCut::finish)
    }

    /// Makes the next cut in the topology. On an error nothing changes.
    pub fn cut(&mut self, part: impl Into<StrokePart>) -> Result<TopologyCut<'_>, CutError> {
        let outcome = self.history.cut(&mut self.topology, part.into())?;
        Ok(self.unfinished(Rest::Levels(outcome)))
    }

    /// Takes back the latest stroke in effect; `None` if there is none.
    pub fn undo(&mut self) -> Option<TopologyCut<'_>> {
        self.replay(|history, topology, replay| history.undo_with(topology, replay))
    }

    /// Repeats the latest stroke that was taken back; `None` if there is none.
    pub fn redo(&mut self) -> Option<Result<TopologyCut<'_>, CutError>> {
        let mut error = None;
        let redone = self.replay(|history, topology, replay| {
            let outcome = history.redo_with(topology, replay)?;
            outcome.map_err(|e| error = Some(e)).ok()
        });
        redone.map(Ok).or_else(|| error.map(Err))
    }

    /// Returns to the uncut tissue; `None` if no cut is in effect or can be redone.
    pub fn reset(&mut self) -> Option<TopologyCut<'_>> {
        if !self.history.can_undo() && !self.history.can_redo() {
            return None;
        }
        self.replay(|history, topology, replay| Some(history.reset_with(topology, replay)))
    }

    /// Makes a change to earlier or repeated cuts.
    fn replay(
        &mut self,
        change: impl FnOnce(&mut CutHistory, &mut Arc<Topology>, &mut Replay<'_>) -> Option<CutOutcome>,
    ) -> Option<TopologyCut<'_>> {
        let mut replay = Replay {
            hierarchy: &mut self.hierarchy,
            construction: &mut self.construction,
            journal: &mut self.journal,
            changes: Chain::new(HierarchyChange::then),
            cuts: 0,
            reached: None,
            is_rebuilt: false,
        };
        let outcome = change(&mut self.history, &mut self.topology, &mut replay)?;
        let change = replay.change();
        let made = self.follow(Arc::new(outcome), change);
        Some(self.unfinished(Rest::Nothing(Box::new(made))))
    }

    fn unfinished(&mut self, rest: Rest) -> TopologyCut<'_> {
        TopologyCut {
            preparer: self,
            rest: Some(rest),
        }
    }

    /// Brings bricks and levels to a cut.
    fn cut_levels(&mut self, outcome: CutOutcome) -> PreparedCut {
        let (construction, topology) = (&mut self.construction, &self.topology);
        let outcome = Arc::new(outcome);
        let (change, way) = self.hierarchy.follow(construction, topology, &outcome);
        self.journal.push(self.history.done().len() - 1, way);
        self.follow(outcome, Some(change))
    }

    /// The newest topology with the change that leads to it; without one all levels are new.
    fn follow(&mut self, outcome: Arc<CutOutcome>, change: Option<HierarchyChange>) -> PreparedCut {
        self.journal.thin(|parts| self.history.returns_to(parts));
        let levels = match change {
            Some(mut change) => {
                if change.separates && self.topology.model().gravity != [0.0; 3] {
                    change.weights = Some(Arc::new(weights(&self.topology)));
                }
                Levels::Changed(Arc::new(change))
            }
            None => self.rebuilt(),
        };
        if self.topology.model().gravity != [0.0; 3] {
            self.reference_state = ReferenceState::of(
                &self.topology,
                &self.hierarchy,
                all_own_stiffness(&self.topology),
                self.reference_state.as_deref(),
            );
        }
        let builds_tree = self.room.follow(&self.topology);
        self.prepared(outcome, levels, builds_tree)
    }

    fn rebuilt(&self) -> Levels {
        let own = all_own_stiffness(&self.topology);
        let mut hierarchy = self.hierarchy.clone();
        hierarchy.reserve();
        let mut fine = FineLevel::new(&self.topology, &self.hierarchy, own);
        fine.disturb_all();
        Levels::Rebuilt(Box::new(Rebuilt {
            fine,
            coarse: Multigrid::new(&self.hierarchy),
            hierarchy,
            index: SurfaceIndex::new(&self.topology),
        }))
    }

    /// The newest cut once more, for another tissue.
    pub fn repeat(&self, cut: &PreparedCut) -> PreparedCut {
        let levels = match &cut.levels {
            Levels::Changed(change) => Levels::Changed(Arc::clone(change)),
            Levels::Rebuilt(_) => self.rebuilt(),
        };
        self.prepared(Arc::clone(&cut.outcome), levels, cut.tree.is_some())
    }

    fn prepared(&self, outcome: Arc<CutOutcome>, levels: Levels, builds_tree: bool) -> PreparedCut {
        PreparedCut {
            topology: Arc::clone(&self.topology),
            history: self.history.clone(),
            outcome,
            levels,
            tree: builds_tree.then(|| SurfaceTree::of(&self.topology)),
            reference_state: self.reference_state.clone(),
        }
    }
}

impl TopologyCut<'_> {
    /// The topology after the cut.
    pub fn topology(&self) -> &Arc<Topology> {
        &self.preparer.topology
    }

    /// Brings bricks and levels to the cut topology.
    pub fn finish(mut self) -> PreparedCut {
        match self.rest.take().expect("only this and drop take it") {
            Rest::Levels(outcome) => self.preparer.cut_levels(outcome),
            Rest::Nothing(made) => *made,
        }
    }
}

impl Drop for TopologyCut<'_> {
    fn drop(&mut self) {
        if let Some(Rest::Levels(outcome)) = self.rest.take() {
            self.preparer.cut_levels(outcome);
        }
    }
}

/// Mean stiffness of every node at rest, in N/m.
pub(super) fn all_own_stiffness(topology: &Topology) -> Vec<f64> {
    let all = (0..topology.node_count() as u32).into_par_iter();
    all.map(|n| own_stiffness(topology, n)).collect()
}

impl Solver {
    /// Prepares later cuts of the current topology.
    pub(crate) fn preparer(&self, topology: &Arc<Topology>, history: CutHistory) -> CutPreparer {
        // The first cut would build it.
        topology.cell_index();
        let mut hierarchy = self.hierarchy.clone();
        hierarchy.reserve();
        CutPreparer {
            topology: Arc::clone(topology),
            construction: Construction::of(topology, &self.hierarchy),
            journal: Journal::new(history.done().len()),
            history,
            room: TreeRoom::of(topology),
            hierarchy,
            reference_state: self.reference_state.clone(),
        }
    }

    /// Adopts the next cut with its topology, its history and its shape.
    pub(crate) fn succeed(
        &mut self,
        topology: &mut Arc<Topology>,
        history: &mut CutHistory,
        shape: &mut Shape,
        mut cut: PreparedCut,
    ) -> Retired {
        match &mut cut.levels {
            Levels::Changed(change) => {
                self.follow(&cut.topology, shape, change, cut.tree.as_mut());
            }
            Levels::Rebuilt(rebuilt) => {
                self.prolongate_all(shape);
                shape.follow(&cut.topology, &cut.outcome);
                self.replace_levels(&cut.topology, rebuilt);
            }
        }
        // A cut changes the equilibrium under gravity.
        self.fine.at_reference &= cut.reference_state.is_none();
        self.reference_state = cut.reference_state;
        Retired {
            _topology: std::mem::replace(topology, cut.topology),
            _history: std::mem::replace(history, cut.history),
            _levels: cut.levels,
            _tree: cut.tree,
        }
    }

    /// Discards all cached forces.
    pub(super) fn restart(&mut self, topology: &Topology, own: Vec<f64>) {
        let mut fine = FineLevel::new(topology, &self.hierarchy, own);
        fine.disturb_all();
        let mut coarse = Multigrid::new(&self.hierarchy);
        self.exchange_levels(&mut fine, &mut coarse);
    }

    /// Continues on newly built levels.
    fn replace_levels(&mut self, topology: &Topology, rebuilt: &mut Rebuilt) {
        let Rebuilt {
            hierarchy,
            fine,
            coarse,
            index,
        } = rebuilt;
        std::mem::swap(&mut self.hierarchy, hierarchy);
        self.contacts.exchange(topology, index);
        self.exchange_levels(fine, coarse);
    }

    /// Exchanges the fine and coarse levels for new ones, whose forces are all outdated.
    fn exchange_levels(&mut self, fine: &mut FineLevel, coarse: &mut Multigrid) {
        let (displaced, at_reference) = (self.fine.displaced, self.fine.at_reference);
        std::mem::swap(&mut self.fine, fine);
        std::mem::swap(&mut self.coarse, coarse);
        self.fine.disabled = self.disabled;
        self.fine.displaced = displaced;
        self.fine.at_reference = at_reference;
        self.coarse.grids[0].starts_at_reference = at_reference;
        self.contact_smoother = ContactSmoother::new(&self.hierarchy);
        self.settling = Some(0);
        self.forget_removed(self.fine.fixed.len());
        for &node in &self.held {
            self.fine.fixed[node as usize] = true;
        }
        self.dirty = true;
    }
}
