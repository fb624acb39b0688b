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
use super::warm_start::WarmStart;
use crate::Topology;
use crate::contact::SurfaceIndex;

/// Follows a topology for solvers on other threads. It costs about 200 bytes per node.
#[derive(Clone)]
pub struct Follower {
    structure: Arc<Hierarchy>,
    own: Vec<f64>,
    index: SurfaceIndex,
    home: Option<Arc<ReferenceState>>,
}

/// Prepared update of one solver.
pub struct Successor {
    pub(super) structure: Arc<Hierarchy>,
    pub(super) field: FineLevel,
    pub(super) coarse: Multigrid,
    pub(super) index: SurfaceIndex,
    pub(super) home: Option<Arc<ReferenceState>>,
}

impl Follower {
    pub(super) fn new(
        structure: &Arc<Hierarchy>,
        own: &[f64],
        index: &SurfaceIndex,
        home: Option<Arc<ReferenceState>>,
    ) -> Self {
        Self {
            structure: Arc::clone(structure),
            own: own.to_vec(),
            index: index.clone(),
            home,
        }
    }

    /// Follows a change of the topology; see [`Solver::follow`](crate::Solver::follow).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.structure, touched);
        self.structure = Arc::new(Hierarchy::after(topology, Some(before)));
        measure(&mut self.own, topology, touched);
        self.home = ReferenceState::of(topology, &self.structure, &self.own, self.home.as_deref());
        self.index.follow(topology);
    }

    pub(super) fn structure(&self) -> &Hierarchy {
        &self.structure
    }

    /// The update for one solver of the topology that was followed last.
    pub fn successor(&self, topology: &Topology) -> Successor {
        let mut field = FineLevel::new(topology, &self.structure, self.own.clone());
        field.disturb_all();
        Successor {
            field,
            coarse: Multigrid::new(&self.structure),
            structure: Arc::clone(&self.structure),
            index: self.index.clone(),
            home: self.home.clone(),
        }
    }
}

impl Solver {
    /// Follows a change of the topology. `touched` are the nodes whose springs, pinning or rest position changed; new
    /// nodes at the end need not be listed. All nodes of the shape must have been up to date before it (see
    /// [`Budget::near`](crate::Budget::near) and [`Solver::pour`]).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.structure, touched);
        self.structure = Arc::new(Hierarchy::after(topology, Some(before)));
        let mut own = std::mem::take(&mut self.field.own);
        measure(&mut own, topology, touched);
        self.home = ReferenceState::of(topology, &self.structure, &own, self.home.as_deref());
        self.restart(topology, own);
        self.contacts.follow(topology);
    }

    /// A follower of later changes of the topology, starting from the current one.
    pub fn follower(&self) -> Follower {
        let home = self.home.clone();
        Follower::new(
            &self.structure,
            &self.field.own,
            self.contacts.index(),
            home,
        )
    }

    /// Installs a change that a [`Follower`] has followed. All nodes of the shape must have been up to date before it,
    /// as for [`follow`](Self::follow).
    pub fn succeed(&mut self, topology: &Topology, successor: Successor) {
        self.structure = successor.structure;
        self.contacts.take(topology, successor.index);
        self.home = successor.home;
        self.begin_again(successor.field, successor.coarse);
    }

    /// Discards all cached forces.
    pub(super) fn restart(&mut self, topology: &Topology, own: Vec<f64>) {
        let mut field = FineLevel::new(topology, &self.structure, own);
        field.disturb_all();
        let coarse = Multigrid::new(&self.structure);
        self.begin_again(field, coarse);
    }

    /// Continues with new fine and coarse levels, whose forces are all outdated.
    fn begin_again(&mut self, field: FineLevel, coarse: Multigrid) {
        let (displaced, at_home) = (self.field.displaced, self.field.at_home);
        (self.field, self.coarse) = (field, coarse);
        self.near = ContactSmoother::new(&self.structure);
        self.foresight = WarmStart::default();
        self.start_over(displaced, at_home);
    }

    /// Takes over displacements and held nodes; all forces are outdated.
    pub(super) fn start_over(&mut self, displaced: f64, at_home: bool) {
        self.field.displaced = displaced;
        self.settling = Some(0);
        // A cut changes the equilibrium under gravity.
        self.field.at_home = at_home && self.home.is_none();
        for &node in &self.held {
            self.field.fixed[node as usize] = true;
        }
        self.dirty = true;
    }
}

/// Updates the stiffness of nodes at rest where a change touched them.
pub(super) fn measure(own: &mut Vec<f64>, topology: &Topology, touched: &[u32]) {
    let new = own.len() as u32..topology.node_count() as u32;
    own.resize(topology.node_count(), 0.0);
    for node in touched.iter().copied().chain(new) {
        own[node as usize] = own_stiffness(topology, node);
    }
}
