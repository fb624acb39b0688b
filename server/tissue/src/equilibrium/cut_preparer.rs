//! A cut, prepared outside the solver thread.
//!
//! A [`CutPreparer`] cuts the topology and computes the change of bricks and levels on another thread. A [`PreparedCut`]
//! then brings any tissue of that topology up to date, in a time that depends on the new faces alone.

use std::sync::Arc;

use rayon::prelude::*;

use super::construction::Construction;
use super::contact_smoother::ContactSmoother;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, own_stiffness};
use super::hierarchy::Hierarchy;
use super::hierarchy_change::HierarchyChange;
use super::reference_state::ReferenceState;
use super::solver::Solver;
use crate::contact::SurfaceIndex;
use crate::cut::{CutError, CutOutcome, StrokePart};
use crate::cut_history::CutHistory;
use crate::{Shape, Topology};

/// Makes cuts ahead of the tissue, on another thread. It costs about 100 bytes per node.
#[derive(Clone)]
pub struct CutPreparer {
    topology: Arc<Topology>,
    history: CutHistory,
    hierarchy: Hierarchy,
    construction: Construction,
    reference_state: Option<Arc<ReferenceState>>,
}

/// A cut that a [`CutPreparer`] has made, for one [`Tissue`](crate::Tissue) to adopt.
pub struct PreparedCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) history: CutHistory,
    pub(crate) outcome: Arc<CutOutcome>,
    levels: Levels,
    reference_state: Option<Arc<ReferenceState>>,
}

/// A cut of the newest topology that bricks and levels do not follow yet: versions and hashes are known in a quarter of the
/// time. It is finished when dropped.
#[must_use]
pub struct TopologyCut<'a> {
    preparer: &'a mut CutPreparer,
    outcome: Option<CutOutcome>,
}

/// Bricks and levels after a cut.
enum Levels {
    /// Changed around the new faces.
    Changed(Arc<HierarchyChange>),
    /// Built from scratch after an undo, a redo or a reset: a change can split levels, but not join them.
    Rebuilt(Box<Rebuilt>),
}

struct Rebuilt {
    hierarchy: Hierarchy,
    fine: FineLevel,
    coarse: Multigrid,
    index: SurfaceIndex,
}

/// Memory that a cut replaced. Freeing it can take milliseconds.
pub struct Retired {
    _topology: Arc<Topology>,
    _history: CutHistory,
    _levels: Option<Box<Rebuilt>>,
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
        Ok(self.unfinished(outcome))
    }

    /// Takes back the latest stroke in effect; `None` if there is none.
    pub fn undo(&mut self) -> Option<TopologyCut<'_>> {
        let outcome = self.history.undo(&mut self.topology)?;
        Some(self.unfinished(outcome))
    }

    /// Repeats the latest stroke that was taken back; `None` if there is none.
    pub fn redo(&mut self) -> Option<Result<TopologyCut<'_>, CutError>> {
        let outcome = self.history.redo(&mut self.topology)?;
        Some(outcome.map(|outcome| self.unfinished(outcome)))
    }

    /// Returns to the uncut tissue; `None` if no cut is in effect or can be redone.
    pub fn reset(&mut self) -> Option<TopologyCut<'_>> {
        let has_cuts = self.history.can_undo() || self.history.can_redo();
        has_cuts.then(|| {
            let outcome = self.history.reset(&mut self.topology);
            self.unfinished(outcome)
        })
    }

    fn unfinished(&mut self, outcome: CutOutcome) -> TopologyCut<'_> {
        TopologyCut {
            preparer: self,
            outcome: Some(outcome),
        }
    }

    /// Brings the solver's data to the newest topology.
    fn follow(&mut self, outcome: CutOutcome) -> PreparedCut {
        let levels = if outcome.is_return() {
            self.hierarchy = Hierarchy::new(&self.topology);
            self.construction = Construction::of(&self.topology, &self.hierarchy);
            self.rebuilt()
        } else {
            let (construction, topology) = (&mut self.construction, &self.topology);
            let change = self.hierarchy.follow(construction, topology, &outcome);
            Levels::Changed(Arc::new(change))
        };
        if self.topology.model().gravity != [0.0; 3] {
            self.reference_state = ReferenceState::of(
                &self.topology,
                &self.hierarchy,
                all_own_stiffness(&self.topology),
                self.reference_state.as_deref(),
            );
        }
        self.prepared(Arc::new(outcome), levels)
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
        self.prepared(Arc::clone(&cut.outcome), levels)
    }

    fn prepared(&self, outcome: Arc<CutOutcome>, levels: Levels) -> PreparedCut {
        PreparedCut {
            topology: Arc::clone(&self.topology),
            history: self.history.clone(),
            outcome,
            levels,
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
        let outcome = self.outcome.take();
        self.preparer
            .follow(outcome.expect("only this and drop take it"))
    }
}

impl Drop for TopologyCut<'_> {
    fn drop(&mut self) {
        if let Some(outcome) = self.outcome.take() {
            self.preparer.follow(outcome);
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
        CutPreparer {
            topology: Arc::clone(topology),
            history,
            construction: Construction::of(topology, &self.hierarchy),
            hierarchy: self.hierarchy.clone(),
            reference_state: self.reference_state.clone(),
        }
    }

    /// Adopts the next cut with its topology, its history and its shape.
    pub(crate) fn succeed(
        &mut self,
        topology: &mut Arc<Topology>,
        history: &mut CutHistory,
        shape: &mut Shape,
        cut: PreparedCut,
    ) -> Retired {
        let levels = match cut.levels {
            Levels::Changed(change) => {
                self.follow(&cut.topology, shape, &cut.outcome, &change);
                None
            }
            Levels::Rebuilt(mut rebuilt) => {
                self.prolongate_all(shape);
                shape.follow(&cut.topology, &cut.outcome);
                self.replace_levels(&cut.topology, &mut rebuilt);
                Some(rebuilt)
            }
        };
        // A cut changes the equilibrium under gravity.
        self.fine.at_reference &= cut.reference_state.is_none();
        self.reference_state = cut.reference_state;
        Retired {
            _topology: std::mem::replace(topology, cut.topology),
            _history: std::mem::replace(history, cut.history),
            _levels: levels,
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
        self.contact_smoother = ContactSmoother::new(&self.hierarchy);
        self.settling = Some(0);
        // An undo removes the nodes at the end.
        let nodes = self.fine.fixed.len();
        self.held.retain(|&n| (n as usize) < nodes);
        self.prescribed_from.retain(|&n, _| (n as usize) < nodes);
        for &node in &self.held {
            self.fine.fixed[node as usize] = true;
        }
        self.dirty = true;
    }
}
