//! A change of the topology, worked out beside the solvers that will take it over.
//!
//! What a solver knows of a topology takes tens of milliseconds to bring up to date after a cut: too
//! long for a hand, whose force is believed for no longer than that. A follower does it on another
//! thread and hands every solver a [`Successor`], which is taken over in less than a millisecond.

use std::sync::Arc;

use super::cycle::Multigrid;
use super::field::{Field, own_stiffness};
use super::structure::Structure;
use crate::Topology;
use crate::contact::SurfaceIndex;

/// Keeps up with a topology for solvers that live elsewhere. It costs about 200 bytes per node.
#[derive(Clone)]
pub struct Follower {
    structure: Arc<Structure>,
    own: Vec<f64>,
    index: SurfaceIndex,
}

/// What one solver needs after a change, ready made.
pub struct Successor {
    pub(super) structure: Arc<Structure>,
    pub(super) field: Field,
    pub(super) coarse: Multigrid,
    pub(super) index: SurfaceIndex,
}

impl Follower {
    pub(super) fn new(structure: &Arc<Structure>, own: &[f64], index: &SurfaceIndex) -> Self {
        Self {
            structure: Arc::clone(structure),
            own: own.to_vec(),
            index: index.clone(),
        }
    }

    /// Follows a change of the topology; see [`Solver::follow`](crate::Solver::follow).
    pub fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let before = (&*self.structure, touched);
        self.structure = Arc::new(Structure::after(topology, Some(before)));
        measure(&mut self.own, topology, touched);
        self.index.follow(topology);
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
        }
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
