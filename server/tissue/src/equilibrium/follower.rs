//! A change of the topology, worked out beside the solvers that will take it over.
//!
//! What a solver knows of a topology takes tens of milliseconds to bring up to date after a cut: too
//! long for a hand, whose force is believed for no longer than that. A follower does it on another
//! thread and hands every solver a [`Successor`], which is taken over in less than a millisecond.

use std::sync::Arc;

use super::cycle::Multigrid;
use super::field::{Field, own_stiffness};
use super::foresight::Foresight;
use super::home::Home;
use super::near::Near;
use super::solver::Solver;
use super::structure::Structure;
use crate::Topology;
use crate::contact::SurfaceIndex;

/// Keeps up with a topology for solvers that live elsewhere. It costs about 200 bytes per node.
#[derive(Clone)]
pub struct Follower {
    structure: Arc<Structure>,
    own: Vec<f64>,
    index: SurfaceIndex,
    home: Option<Arc<Home>>,
}

/// What one solver needs after a change, ready made.
pub struct Successor {
    pub(super) structure: Arc<Structure>,
    pub(super) field: Field,
    pub(super) coarse: Multigrid,
    pub(super) index: SurfaceIndex,
    pub(super) home: Option<Arc<Home>>,
}

impl Follower {
    pub(super) fn new(
        structure: &Arc<Structure>,
        own: &[f64],
        index: &SurfaceIndex,
        home: Option<Arc<Home>>,
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
        self.structure = Arc::new(Structure::after(topology, Some(before)));
        measure(&mut self.own, topology, touched);
        self.home = Home::of(topology, &self.structure, &self.own, self.home.as_deref());
        self.index.follow(topology);
    }

    pub(super) fn structure(&self) -> &Structure {
        &self.structure
    }

    /// What one solver of the topology that was followed last needs.
    pub fn successor(&self, topology: &Topology) -> Successor {
        let mut field = Field::new(topology, &self.structure, self.own.clone());
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
    /// Follows a change of the topology. `touched` are the nodes whose springs, pinning or rest
    /// position changed; new nodes at the end need not be listed. The shape must have been whole
    /// before it (see [`Budget::near`](crate::Budget::near) and [`Solver::pour`]).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.structure, touched);
        self.structure = Arc::new(Structure::after(topology, Some(before)));
        let mut own = std::mem::take(&mut self.field.own);
        measure(&mut own, topology, touched);
        self.home = Home::of(topology, &self.structure, &own, self.home.as_deref());
        self.restart(topology, own);
        self.contacts.follow(topology);
    }

    /// One that follows changes of the topology beside this solver, from the topology of now on.
    pub fn follower(&self) -> Follower {
        let home = self.home.clone();
        Follower::new(
            &self.structure,
            &self.field.own,
            self.contacts.index(),
            home,
        )
    }

    /// Follows a change of the topology that a [`Follower`] has followed. The shape must have been
    /// whole before it, as for [`follow`](Self::follow).
    pub fn succeed(&mut self, topology: &Topology, successor: Successor) {
        self.structure = successor.structure;
        self.contacts.take(topology, successor.index);
        self.home = successor.home;
        self.begin_again(successor.field, successor.coarse);
    }

    /// Forgets all that was known of forces.
    pub(super) fn restart(&mut self, topology: &Topology, own: Vec<f64>) {
        let mut field = Field::new(topology, &self.structure, own);
        field.disturb_all();
        let coarse = Multigrid::new(&self.structure);
        self.begin_again(field, coarse);
    }

    /// Goes on with a field and levels of which every force is still to be computed.
    fn begin_again(&mut self, field: Field, coarse: Multigrid) {
        let (displaced, at_home) = (self.field.displaced, self.field.at_home);
        (self.field, self.coarse) = (field, coarse);
        self.near = Near::new(&self.structure);
        self.foresight = Foresight::default();
        self.start_over(displaced, at_home);
    }

    /// Takes over how far nodes are displaced, and what is held, where every force is still to be computed.
    pub(super) fn start_over(&mut self, displaced: f64, at_home: bool) {
        self.field.displaced = displaced;
        self.settling = Some(0);
        // A cut moves what hangs.
        self.field.at_home = at_home && self.home.is_none();
        for &node in &self.held {
            self.field.fixed[node as usize] = true;
        }
        self.dirty = true;
    }
}

/// Brings the stiffness of nodes at rest up to date where a change touched them.
pub(super) fn measure(own: &mut Vec<f64>, topology: &Topology, touched: &[u32]) {
    let new = own.len() as u32..topology.node_count() as u32;
    own.resize(topology.node_count(), 0.0);
    for node in touched.iter().copied().chain(new) {
        own[node as usize] = own_stiffness(topology, node);
    }
}
