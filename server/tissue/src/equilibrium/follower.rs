//! A change of the topology, prepared outside the solver thread.
//!
//! Updating a solver after a cut takes tens of milliseconds, too long for the haptic loop, whose forces expire before
//! that. A follower computes the update on another thread and returns a [`Successor`] for every solver, which takes
//! less than a millisecond to install.

use std::sync::Arc;

use super::contact_smoother::ContactSmoother;
use super::cycle::Multigrid;
use super::fine_level::{FineLevel, own_stiffness};
use super::hierarchy::Hierarchy;
use super::reference_state::ReferenceState;
use super::solver::Solver;
use crate::Topology;
use crate::contact::SurfaceIndex;

/// Follows a topology for solvers on other threads. It costs about 200 bytes per node.
#[derive(Clone)]
pub struct Follower {
    hierarchy: Arc<Hierarchy>,
    own: Vec<f64>,
    index: SurfaceIndex,
    reference_state: Option<Arc<ReferenceState>>,
}

/// Prepared update of one solver.
pub struct Successor {
    pub(super) hierarchy: Arc<Hierarchy>,
    pub(super) fine: FineLevel,
    pub(super) coarse: Multigrid,
    pub(super) index: SurfaceIndex,
    pub(super) reference_state: Option<Arc<ReferenceState>>,
}

impl Follower {
    pub(super) fn new(
        hierarchy: &Arc<Hierarchy>,
        own: &[f64],
        index: &SurfaceIndex,
        reference_state: Option<Arc<ReferenceState>>,
    ) -> Self {
        Self {
            hierarchy: Arc::clone(hierarchy),
            own: own.to_vec(),
            index: index.clone(),
            reference_state,
        }
    }

    /// Follows a change of the topology; see [`Solver::follow`](crate::Solver::follow).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.hierarchy, touched);
        self.hierarchy = Arc::new(Hierarchy::after(topology, Some(before)));
        update_stiffness(&mut self.own, topology, touched);
        self.reference_state = ReferenceState::of(
            topology,
            &self.hierarchy,
            &self.own,
            self.reference_state.as_deref(),
        );
        self.index.follow(topology);
    }

    pub(super) fn hierarchy(&self) -> &Hierarchy {
        &self.hierarchy
    }

    /// The update for one solver of the topology that was followed last.
    pub fn successor(&self, topology: &Topology) -> Successor {
        let mut fine = FineLevel::new(topology, &self.hierarchy, self.own.clone());
        fine.disturb_all();
        Successor {
            fine,
            coarse: Multigrid::new(&self.hierarchy),
            hierarchy: Arc::clone(&self.hierarchy),
            index: self.index.clone(),
            reference_state: self.reference_state.clone(),
        }
    }
}

impl Solver {
    /// Follows a change of the topology. `touched` are the nodes whose springs, pinning or rest position changed; new
    /// nodes at the end need not be listed. All nodes of the shape must have been up to date before it (see
    /// [`Budget::near`](crate::Budget::near) and [`Solver::prolongate_all`]).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.hierarchy, touched);
        self.hierarchy = Arc::new(Hierarchy::after(topology, Some(before)));
        let mut own = std::mem::take(&mut self.fine.own);
        update_stiffness(&mut own, topology, touched);
        self.reference_state = ReferenceState::of(
            topology,
            &self.hierarchy,
            &own,
            self.reference_state.as_deref(),
        );
        self.restart(topology, own);
        self.contacts.follow(topology);
    }

    /// A follower of later changes of the topology, starting from the current one.
    pub fn follower(&self) -> Follower {
        let reference_state = self.reference_state.clone();
        Follower::new(
            &self.hierarchy,
            &self.fine.own,
            self.contacts.index(),
            reference_state,
        )
    }

    /// Installs a change that a [`Follower`] has followed. All nodes of the shape must have been up to date before it,
    /// as for [`follow`](Self::follow).
    pub fn succeed(&mut self, topology: &Topology, successor: Successor) {
        self.hierarchy = successor.hierarchy;
        self.contacts.take(topology, successor.index);
        self.reference_state = successor.reference_state;
        self.replace_levels(successor.fine, successor.coarse);
    }

    /// Discards all cached forces.
    pub(super) fn restart(&mut self, topology: &Topology, own: Vec<f64>) {
        let mut fine = FineLevel::new(topology, &self.hierarchy, own);
        fine.disturb_all();
        let coarse = Multigrid::new(&self.hierarchy);
        self.replace_levels(fine, coarse);
    }

    /// Continues with new fine and coarse levels, whose forces are all outdated.
    fn replace_levels(&mut self, fine: FineLevel, coarse: Multigrid) {
        let (displaced, at_reference) = (self.fine.displaced, self.fine.at_reference);
        (self.fine, self.coarse) = (fine, coarse);
        self.fine.disabled = self.disabled;
        self.contact_smoother = ContactSmoother::new(&self.hierarchy);
        self.restore_state(displaced, at_reference);
    }

    /// Takes over displacements and held nodes; all forces are outdated.
    pub(super) fn restore_state(&mut self, displaced: f64, at_reference: bool) {
        self.fine.displaced = displaced;
        self.settling = Some(0);
        // A cut changes the equilibrium under gravity.
        self.fine.at_reference = at_reference && self.reference_state.is_none();
        for &node in &self.held {
            self.fine.fixed[node as usize] = true;
        }
        self.dirty = true;
    }
}

/// Updates the stiffness of nodes at rest where a change touched them.
pub(super) fn update_stiffness(own: &mut Vec<f64>, topology: &Topology, touched: &[u32]) {
    let new = own.len() as u32..topology.node_count() as u32;
    own.resize(topology.node_count(), 0.0);
    for node in touched.iter().copied().chain(new) {
        own[node as usize] = own_stiffness(topology, node);
    }
}
