//! The authoritative tissue as two state machines: the shape in equilibrium, and the preparation of cuts.
//!
//! ```text
//! Room --TissueOrder::Settle--> Authority --TissueReport::Settled--> Room
//! Room --TissueOrder::Cut-----> Authority --CutJob--> Cutter --TissueReport::Cut--> Room (log, at = now)
//!                                          <--PreparedCut--
//! Room --TissueOrder::Apply---> Authority: the prepared cut enters the first view whose time has reached `at`
//! ```
//!
//! A cut takes a hundred milliseconds, an equilibrium up to ten. A server therefore runs each on its own thread, and
//! the room, which relays motion, waits for neither.

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::datagram::Corrections;
use palpate_protocol::operation::CutStroke;
use palpate_protocol::request::{CutRequest, RequestRefusal};
use palpate_protocol::session::Picture;
use palpate_protocol::{ParticipantId, RequestId, ServerTime, Span, TopologyHash};
use palpate_tissue::{
    Budget, CutError, CutOutcome, Follower, Model, Shape, Solver, Successor, Tool, Topology, cut,
};

use crate::convert;
use crate::pictures::Pictures;

/// Relative residual at which a tick has converged: forces are within a few percent, and shapes of replicas within
/// 0.1 mm of each other.
const TOLERANCE: f64 = 2e-2;

/// Maximum iterations of one tick, independent of the time limit of the server.
const ITERATIONS_MAX: usize = 1;

/// Smaller displacements are invisible and need no correction.
const DISPLACED_M: f64 = 5e-5;

/// Nodes of one round of corrections; they fit into one datagram.
const CORRECTIONS_MAX: usize = 120;

/// Orders for the tissue, executed in sequence.
#[derive(Debug, Clone)]
pub enum TissueOrder {
    /// Solve the equilibrium under the tools of one view time.
    Settle(Settling),
    /// Make a cut.
    Cut(CutOrder),
    /// Apply the prepared cut that leads to a topology version.
    Apply {
        /// The version after the cut.
        version: u32,
        /// The first view time that shows it.
        at: ServerTime,
    },
}

/// One tick of the tissue.
#[derive(Debug, Clone)]
pub struct Settling {
    /// The view time to solve for.
    pub view_time: ServerTime,
    /// The tools that press at that time.
    pub tools: Vec<Tool>,
    /// Whether corrections are due.
    pub wants_corrections: bool,
    /// Due time of the tick, if there is a thin subscriber.
    pub wants_picture: Option<ServerTime>,
}

/// A request to cut.
#[derive(Debug, Clone)]
pub struct CutOrder {
    /// The participant that cuts.
    pub author: ParticipantId,
    /// The number of the request.
    pub request: RequestId,
    /// The stroke in the deformed frame.
    pub cut: CutRequest,
}

/// Report on an order. [`Apply`](TissueOrder::Apply) has none.
#[derive(Debug, Clone)]
pub enum TissueReport {
    /// A tick is done.
    Settled {
        /// Statistics of the tick.
        tick: TickReport,
        /// Displacements for comparison by clients, if they were due.
        corrections: Option<Arc<Corrections>>,
        /// The surface, if it was due.
        picture: Option<Arc<Picture>>,
    },
    /// A cut is prepared, or refused.
    Cut {
        /// The participant that cuts.
        author: ParticipantId,
        /// The number of the request.
        request: RequestId,
        /// The stroke in the rest frame and the topology after it.
        result: Result<LoggedCut, RequestRefusal>,
        /// CPU time of the preparation, charged to the author. The thread that calls [`Cutter::make`] measures it.
        took: Span,
    },
}

/// A prepared cut as the log describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedCut {
    /// The stroke in the rest frame, for every replica to repeat.
    pub stroke: CutStroke,
    /// Topology version after it.
    pub version: u32,
    /// Topology hash after it.
    pub hash: TopologyHash,
}

/// Statistics of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickReport {
    /// The view time that was solved for.
    pub view_time: ServerTime,
    /// Tools that pressed.
    pub tools: usize,
    /// Iterations of the solver.
    pub iterations: usize,
    /// Relative residual.
    pub residual: f64,
    /// Active nodes.
    pub active_nodes: usize,
}

/// The authoritative shape.
///
/// Calling order: [`settle`](Self::settle) with ascending times; [`take_cut`](Self::take_cut) for every cut that the
/// [`Cutter`] prepared, in order; [`apply`](Self::apply) once the cut is in the log.
pub struct Authority {
    topology: Arc<Topology>,
    shape: Shape,
    solver: Solver,
    view_time: ServerTime,
    prepared: VecDeque<PreparedCut>,
    /// Times at which cuts take effect, by topology version. The prepared cut may arrive later.
    due: VecDeque<(u32, ServerTime)>,
    pictures: Pictures,
}

/// A cut for the cutter to prepare.
#[derive(Debug, Clone)]
pub struct CutJob {
    author: ParticipantId,
    request: RequestId,
    stroke: CutStroke,
}

/// A cut that waits for the view in which it takes effect.
pub struct PreparedCut {
    topology: Arc<Topology>,
    outcome: CutOutcome,
    successor: Successor,
}

/// The newest topology of the log, ahead of the shape by the cuts that are not yet in effect.
pub struct Cutter {
    topology: Arc<Topology>,
    follower: Follower,
}

impl Authority {
    /// The uncut tissue and its cutter.
    pub fn new(model: Arc<Model>) -> (Self, Cutter) {
        let topology = Arc::new(Topology::new(model));
        let shape = Shape::rest(&topology);
        let solver = Solver::new(&topology);
        let cutter = Cutter {
            topology: Arc::clone(&topology),
            follower: solver.follower(),
        };
        let authority = Self {
            topology,
            shape,
            solver,
            view_time: ServerTime::ZERO,
            prepared: VecDeque::new(),
            due: VecDeque::new(),
            pictures: Pictures::default(),
        };
        (authority, cutter)
    }

    /// Applies the cuts that are due, then solves the equilibrium under the tools. `stop` ends the solve early.
    pub fn settle(&mut self, order: &Settling, stop: &mut dyn FnMut() -> bool) -> TissueReport {
        self.take_effect(order.view_time);
        let mut budget = Budget::new(ITERATIONS_MAX, TOLERANCE);
        budget.stop = Some(stop);
        let report = self
            .solver
            .step(&self.topology, &mut self.shape, &order.tools, budget);
        let tick = TickReport {
            view_time: order.view_time,
            tools: order.tools.len(),
            iterations: report.iterations,
            residual: report.residual,
            active_nodes: report.active_nodes,
        };
        self.view_time = order.view_time;
        let corrections = order.wants_corrections.then(|| self.corrections());
        let picture = (order.wants_picture).and_then(|due| self.picture(due));
        TissueReport::Settled {
            tick,
            corrections: corrections.flatten().map(Arc::new),
            picture,
        }
    }

    /// Maps the stroke of a request to the rest frame.
    pub fn job(&self, order: &CutOrder) -> CutJob {
        CutJob {
            author: order.author,
            request: order.request,
            stroke: convert::stroke_at_rest(&order.cut, &self.topology, &self.shape),
        }
    }

    /// Stores a prepared cut until [`apply`](Self::apply).
    pub fn take_cut(&mut self, cut: PreparedCut) {
        self.prepared.push_back(cut);
    }

    /// Schedules the cut that leads to `version` for views from time `at` on.
    pub fn apply(&mut self, version: u32, at: ServerTime) {
        self.due.push_back((version, at));
    }

    fn take_effect(&mut self, view_time: ServerTime) {
        while let Some(&(version, at)) = self.due.front()
            && at <= view_time
            && let Some(cut) = self.prepared.front()
            && cut.topology.version() == version
        {
            self.due.pop_front();
            if let Some(cut) = self.prepared.pop_front() {
                self.solver.prolongate_all(&mut self.shape);
                self.topology = cut.topology;
                self.shape.follow(&self.topology, &cut.outcome);
                self.solver.succeed(&self.topology, cut.successor);
            }
        }
    }

    /// The surface of the newest tick, if a picture is due.
    fn picture(&mut self, due: ServerTime) -> Option<Arc<Picture>> {
        let topology = &self.topology;
        let nodes = self.pictures.poll(topology, due)?;
        let of = |n: &u32| {
            let d = self.shape.displacement[*n as usize];
            [d.x as f32, d.y as f32, d.z as f32]
        };
        Some(Arc::new(Picture {
            topology_version: topology.version(),
            view_time: self.view_time,
            displacements: nodes.iter().map(of).collect(),
            nodes,
        }))
    }

    /// Displacements for comparison by clients: an even selection of the displaced nodes.
    fn corrections(&self) -> Option<Corrections> {
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

impl Cutter {
    /// Prepares a cut. The report is for the room; the prepared cut, if there is one, for the [`Authority`].
    pub fn make(&mut self, job: &CutJob) -> (TissueReport, Option<PreparedCut>) {
        let report = |result| TissueReport::Cut {
            author: job.author,
            request: job.request,
            result,
            took: Span::ZERO,
        };
        let topology = Arc::make_mut(&mut self.topology);
        let outcome = match cut(topology, &convert::stroke_to_tissue(&job.stroke)) {
            Ok(outcome) => outcome,
            Err(CutError::NothingNew) => return (report(Err(RequestRefusal::NothingCut)), None),
            Err(other) => {
                let refusal = RequestRefusal::CanNotCut(other.to_string());
                return (report(Err(refusal)), None);
            }
        };
        self.follower.follow(&self.topology, &outcome.touched);
        let prepared = PreparedCut {
            topology: Arc::clone(&self.topology),
            successor: self.follower.successor(&self.topology),
            outcome,
        };
        let logged = LoggedCut {
            stroke: job.stroke.clone(),
            version: self.topology.version(),
            hash: self.hash(),
        };
        (report(Ok(logged)), Some(prepared))
    }

    /// Hash of the newest topology.
    pub fn hash(&self) -> TopologyHash {
        TopologyHash(self.topology.hash().0)
    }

    /// Connected components of the cells. Visits the whole model.
    pub fn components(&self) -> usize {
        self.topology.components()
    }

    /// Whether every edge of the boundary belongs to exactly two triangles. Visits the whole surface.
    pub fn boundary_closed(&self) -> bool {
        self.topology.boundary().is_closed()
    }
}
