//! The authoritative tissue: the one shape and the one topology that count.

use std::sync::Arc;

use palpate_protocol::ServerTime;
use palpate_protocol::datagram::Corrections;
use palpate_protocol::operation::CutStroke;
use palpate_protocol::request::{CutRequest, RequestRefusal};
use palpate_protocol::session::Picture;
use palpate_tissue::{
    Budget, CutError, Model, Shape, Solver, Tool, Topology, TopologyHash, cut, report_surface,
};

use crate::convert;

/// Relative residual at which a tick's equilibrium is good enough: forces are then within a few
/// percent, and shapes within a tenth of a millimetre of each other from site to site.
const TOLERANCE: f64 = 2e-2;

/// Iterations of one tick at most, should the shell's time limit never come.
const ITERATIONS_MAX: usize = 2;

/// A displacement below this needs no correction: it can not be seen.
const DISPLACED_M: f64 = 5e-5;

/// Nodes of one round of corrections: they fit into one datagram.
const CORRECTIONS_MAX: usize = 120;

/// What a tick did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickReport {
    /// The moment that the tissue now stands at.
    pub view_time: ServerTime,
    /// Tools that pressed.
    pub tools: usize,
    /// Iterations of the solver.
    pub iterations: usize,
    /// Relative residual that is left.
    pub residual: f64,
    /// Nodes still active.
    pub active_nodes: usize,
}

/// Tissue with its solver.
pub(crate) struct Authority {
    topology: Topology,
    shape: Shape,
    solver: Solver,
    /// Topology hash after each operation, by version.
    hashes: Vec<TopologyHash>,
    view_time: ServerTime,
}

impl Authority {
    pub(crate) fn new(model: Arc<Model>) -> Self {
        let topology = Topology::new(model);
        let shape = Shape::rest(&topology);
        let solver = Solver::new(&topology);
        let hashes = vec![topology.hash()];
        Self {
            topology,
            shape,
            solver,
            hashes,
            view_time: ServerTime::ZERO,
        }
    }

    pub(crate) fn version(&self) -> u32 {
        self.topology.version()
    }

    /// Hash of the topology at a version, if it has been reached.
    pub(crate) fn hash_at(&self, version: u32) -> Option<TopologyHash> {
        self.hashes.get(version as usize).copied()
    }

    pub(crate) fn hash(&self) -> TopologyHash {
        self.hashes[self.hashes.len() - 1]
    }

    pub(crate) fn components(&self) -> usize {
        self.topology.components()
    }

    pub(crate) fn boundary_closed(&self) -> bool {
        report_surface(self.topology.boundary()).closed
    }

    /// Brings the tissue into equilibrium under the tools of a moment.
    pub(crate) fn settle(
        &mut self,
        view_time: ServerTime,
        tools: &[Tool],
        stop: &mut dyn FnMut() -> bool,
    ) -> TickReport {
        let mut budget = Budget::new(ITERATIONS_MAX, TOLERANCE);
        budget.stop = Some(stop);
        let report = self
            .solver
            .step(&self.topology, &mut self.shape, tools, budget);
        self.view_time = view_time;
        TickReport {
            view_time,
            tools: tools.len(),
            iterations: report.iterations,
            residual: report.residual,
            active_nodes: report.active_nodes,
        }
    }

    /// Cuts where a blade has gone; gives the stroke in the rest frame, for everybody to repeat.
    pub(crate) fn cut(&mut self, request: &CutRequest) -> Result<CutStroke, RequestRefusal> {
        let stroke = convert::stroke_at_rest(request, &self.topology, &self.shape);
        let outcome = cut(&mut self.topology, &convert::stroke_to_tissue(&stroke));
        let outcome = outcome.map_err(|error| match error {
            CutError::NothingNew => RequestRefusal::NothingCut,
            other => RequestRefusal::CanNotCut(other.to_string()),
        })?;
        self.shape.follow(&self.topology, &outcome);
        self.solver.follow(&self.topology, &outcome.touched);
        self.hashes.push(self.topology.hash());
        Ok(stroke)
    }

    /// The nodes that can be seen, ascending: those of the outer surface, cuts included.
    pub(crate) fn nodes_in_view(&self) -> Arc<[u32]> {
        let triangles = &self.topology.boundary().triangles;
        let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
        nodes.sort_unstable();
        nodes.dedup();
        nodes.into()
    }

    /// Where nodes are, and for which moment.
    pub(crate) fn picture(&self, nodes: &Arc<[u32]>) -> Picture {
        let of = |n: &u32| {
            let d = self.shape.displacement[*n as usize];
            [d.x as f32, d.y as f32, d.z as f32]
        };
        Picture {
            topology_version: self.topology.version(),
            view_time: self.view_time,
            nodes: Arc::clone(nodes),
            displacements: nodes.iter().map(of).collect(),
        }
    }

    /// Displacements for others to compare with: an even choice of the nodes that have moved.
    pub(crate) fn corrections(&self) -> Option<Corrections> {
        let moved: Vec<u32> = (0..self.shape.displacement.len() as u32)
            .filter(|&n| {
                let by = self.shape.displacement[n as usize] - self.solver.sag_of(n);
                by.norm() > DISPLACED_M
            })
            .collect();
        let step = moved.len().div_ceil(CORRECTIONS_MAX).max(1);
        let nodes: Vec<(u32, [f32; 3])> = moved
            .into_iter()
            .step_by(step)
            .map(|n| {
                let d = self.shape.displacement[n as usize];
                (n, [d.x as f32, d.y as f32, d.z as f32])
            })
            .collect();
        (!nodes.is_empty()).then(|| Corrections {
            topology_version: self.topology.version(),
            view_time: self.view_time,
            nodes,
        })
    }
}
