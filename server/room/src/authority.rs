//! The authoritative tissue as two state machines: the shape in equilibrium, and the preparation of cuts.
//!
//! ```text
//! Room --TissueOrder::Settle--> Authority --TissueReport::Settled--> Room
//! Room --TissueOrder::Cut-----> Authority --CutJob--> Cutter --TissueReport::Cut--> Room (log)
//!                                          <--PreparedCut--
//! Room --TissueOrder::Apply---> Authority: the prepared cut enters the first view whose time has reached `at`
//! Room --TissueOrder::Snapshot---------------------> Cutter --TissueReport::Snapshot--> Room (newcomers)
//! ```
//!
//! A part of a stroke takes some milliseconds, an undo a hundred, an equilibrium up to ten. A server therefore runs each on its own thread, and
//! the room, which relays motion, waits for neither.

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::datagram::Corrections;
use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::{CutRequest, RequestRefusal, TimedBladePoint};
use palpate_protocol::session::Picture;
use palpate_protocol::tool::{part_id, part_owner};
use palpate_protocol::{ParticipantId, RequestId, ServerTime, Span, TopologyHash};
use palpate_tissue::snapshot::snapshot;
use palpate_tissue::{
    BladePoint, Blades, Budget, CutError, CutPreparer, Model, PreparedCut, Reaction, Shape, Tissue,
    Tool, Topology, TopologyCut,
};

use crate::convert;
use crate::open_strokes::{OpenStrokes, RestPart};
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
    /// Take a snapshot of the newest topology and its strokes, after the cuts before this order.
    Snapshot,
}

/// One tick of the tissue.
#[derive(Debug, Clone)]
pub struct Settling {
    /// The view time to solve for.
    pub view_time: ServerTime,
    /// The tools that press at that time.
    pub tools: Vec<Tool>,
    /// The edges of the blades that cut at that time, by participant.
    pub blades: Vec<(ParticipantId, BladePoint)>,
    /// Whether one of them returns from a hold.
    pub returns: bool,
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
    /// The requested change.
    pub change: RequestedChange,
}

/// A change of the topology as it was requested.
#[derive(Debug, Clone, PartialEq)]
pub enum RequestedChange {
    /// A cut along a stroke in the deformed frame.
    Cut(CutRequest),
    /// Takes back the last cut.
    Undo,
    /// Repeats the last cut that was taken back.
    Redo,
    /// Returns to the uncut tissue.
    Reset,
}

/// Report on an order. [`Apply`](TissueOrder::Apply) has none.
#[derive(Debug, Clone)]
pub enum TissueReport {
    /// A tick is done.
    Settled {
        /// Statistics of the tick.
        tick: TickReport,
        /// Holders of the needles that the tissue holds from now on, by the decision of this shape.
        inserted: Vec<ParticipantId>,
        /// Displacements for comparison by clients, if they were due.
        corrections: Option<Arc<Corrections>>,
        /// The surface, if it was due.
        picture: Option<Arc<Picture>>,
    },
    /// The topology of a cut is known, or the cut refused.
    Cut {
        /// The participant that cuts.
        author: ParticipantId,
        /// The number of the request.
        request: RequestId,
        /// The stroke in the rest frame and the topology after it.
        result: Result<LoggedCut, RequestRefusal>,
    },
    /// The preparation of a cut has ended, also of a refused one.
    Prepared {
        /// The participant that cuts.
        author: ParticipantId,
        /// CPU time of the preparation, charged to the author. The thread that calls [`Cutter::make`] measures it.
        took: Span,
    },
    /// A snapshot for newcomers.
    Snapshot {
        /// Topology version that it restores.
        version: u32,
        /// The content for [`palpate_tissue::snapshot::restore`].
        bytes: Vec<u8>,
    },
}

/// A prepared cut as the log describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedCut {
    /// The change; a stroke is in the rest frame. Every replica repeats it.
    pub change: OperationKind,
    /// Topology version after it.
    pub version: u32,
    /// Topology hash after it.
    pub hash: TopologyHash,
    /// When the blade was at the end of the path.
    pub blade_at: Option<ServerTime>,
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
    tissue: Tissue,
    view_time: ServerTime,
    prepared: VecDeque<PreparedCut>,
    /// Times at which cuts take effect, by topology version. The prepared cut may arrive later.
    due: VecDeque<(u32, ServerTime)>,
    pictures: Pictures,
    blades: Blades,
}

/// A cut for the cutter to prepare.
#[derive(Debug, Clone)]
pub struct CutJob {
    author: ParticipantId,
    request: RequestId,
    change: ChangeAtRest,
}

impl CutJob {
    /// Maps the stroke of a request from this shape to the rest frame.
    pub fn new(order: &CutOrder, topology: &Topology, shape: &Shape) -> Self {
        let change = match &order.change {
            RequestedChange::Cut(cut) => {
                let time = |point: Option<&TimedBladePoint>| point.map_or(cut.began, |p| p.time);
                ChangeAtRest::Cut(RestPart {
                    began: cut.began,
                    times: [cut.points.first(), cut.points.last()].map(time),
                    points: convert::path_at_rest(cut, topology, shape),
                    width_m: cut.width_m,
                    is_last: cut.is_last,
                })
            }
            RequestedChange::Undo => ChangeAtRest::Undo,
            RequestedChange::Redo => ChangeAtRest::Redo,
            RequestedChange::Reset => ChangeAtRest::Reset,
        };
        Self {
            author: order.author,
            request: order.request,
            change,
        }
    }

    /// The participant that cuts.
    pub fn author(&self) -> ParticipantId {
        self.author
    }
}

/// A change of the topology, in the rest frame.
#[derive(Debug, Clone)]
enum ChangeAtRest {
    Cut(RestPart),
    Undo,
    Redo,
    Reset,
}

/// The newest topology of the log, ahead of the shape by the cuts that are not yet in effect.
pub struct Cutter {
    preparer: CutPreparer,
    strokes: OpenStrokes,
}

impl Authority {
    /// The uncut tissue and its cutter.
    pub fn new(model: Arc<Model>) -> (Self, Cutter) {
        Self::of(Tissue::new(model))
    }

    /// This tissue, perhaps with cuts, and its cutter.
    pub fn of(tissue: Tissue) -> (Self, Cutter) {
        let cutter = Cutter {
            preparer: tissue.preparer(),
            strokes: OpenStrokes::default(),
        };
        let authority = Self {
            tissue,
            view_time: ServerTime::ZERO,
            prepared: VecDeque::new(),
            due: VecDeque::new(),
            pictures: Pictures::default(),
            blades: Blades::default(),
        };
        (authority, cutter)
    }

    /// Applies the cuts that are due, then solves the equilibrium under the tools. `stop` ends the solve early.
    pub fn settle(&mut self, order: &Settling, stop: &mut dyn FnMut() -> bool) -> TissueReport {
        self.take_effect(order.view_time);
        let mut budget = Budget::new(ITERATIONS_MAX, TOLERANCE);
        budget.stop = Some(stop);
        let report = self.tissue.step(&order.tools, budget);
        let tick = TickReport {
            view_time: order.view_time,
            tools: order.tools.len(),
            iterations: report.iterations,
            residual: report.residual,
            active_nodes: report.active_nodes,
        };
        let inserted = report.reactions.iter().filter(|r| r.is_inserted);
        let inserted = inserted.map(|r| part_owner(r.tool)).collect();
        let blades = order.blades.iter();
        let blades: Vec<_> = blades
            .map(|(who, blade)| (part_id(*who, 0), *blade))
            .collect();
        self.blades.follow(&blades, &self.tissue);
        self.view_time = order.view_time;
        let corrections = order.wants_corrections.then(|| self.corrections());
        let picture = (order.wants_picture).and_then(|due| self.picture(due));
        TissueReport::Settled {
            tick,
            inserted,
            corrections: corrections.flatten().map(Arc::new),
            picture,
        }
    }

    /// The tissue at the newest tick.
    pub fn tissue(&self) -> &Tissue {
        &self.tissue
    }

    /// The reactions of the newest tick on all tools, cutting blades included.
    pub fn reactions(&self) -> Vec<Reaction> {
        let pressing = self.tissue.report().reactions.iter();
        pressing.chain(self.blades.reactions()).cloned().collect()
    }

    /// Maps the stroke of a request to the rest frame.
    pub fn job(&self, order: &CutOrder) -> CutJob {
        CutJob::new(order, self.tissue.topology(), self.tissue.shape())
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
            && cut.topology().version() == version
        {
            self.due.pop_front();
            if let Some(cut) = self.prepared.pop_front() {
                self.tissue.succeed(cut);
            }
        }
    }

    /// The surface of the newest tick, if a picture is due.
    fn picture(&mut self, due: ServerTime) -> Option<Arc<Picture>> {
        let topology = self.tissue.topology();
        let nodes = self.pictures.poll(topology, due)?;
        let of = |n: &u32| {
            let d = self.tissue.shape().displacement[*n as usize];
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
        let displacement = &self.tissue.shape().displacement;
        let moved: Vec<u32> = (0..displacement.len() as u32)
            .filter(|&n| {
                let by = displacement[n as usize] - self.tissue.sag_of(n);
                by.norm() > DISPLACED_M
            })
            .collect();
        let step = moved.len().div_ceil(CORRECTIONS_MAX).max(1);
        let nodes: Vec<(u32, [f32; 3])> = moved
            .into_iter()
            .step_by(step)
            .map(|n| {
                let d = displacement[n as usize];
                (n, [d.x as f32, d.y as f32, d.z as f32])
            })
            .collect();
        (!nodes.is_empty()).then(|| Corrections {
            topology_version: self.tissue.topology().version(),
            view_time: self.view_time,
            nodes,
        })
    }
}

impl Cutter {
    /// Cuts the topology. The report is for the room at once, so that the replicas prepare the cut at the same time; the
    /// finished cut, if there is one, for the [`Authority`].
    pub fn make(&mut self, job: &CutJob) -> (TissueReport, Option<TopologyCut<'_>>) {
        let report = |result| TissueReport::Cut {
            author: job.author,
            request: job.request,
            result,
        };
        let (change, cut) = match self.cut(job) {
            Ok(made) => made,
            Err(refusal) => return (report(Err(refusal)), None),
        };
        let logged = LoggedCut {
            change,
            version: cut.topology().version(),
            hash: TopologyHash(cut.topology().hash().0),
            blade_at: match &job.change {
                ChangeAtRest::Cut(part) => Some(part.times[1]),
                _ => None,
            },
        };
        (report(Ok(logged)), Some(cut))
    }

    fn cut(&mut self, job: &CutJob) -> Result<(OperationKind, TopologyCut<'_>), RequestRefusal> {
        let nothing = RequestRefusal::NothingToUndo;
        let (change, result) = match &job.change {
            ChangeAtRest::Cut(part) => return self.extend(job.author, part),
            ChangeAtRest::Redo => (
                OperationKind::Redone,
                (self.preparer.redo()).ok_or(RequestRefusal::NothingToRedo)?,
            ),
            ChangeAtRest::Undo => (
                OperationKind::Undone,
                Ok(self.preparer.undo().ok_or(nothing)?),
            ),
            ChangeAtRest::Reset => (
                OperationKind::Reset,
                Ok(self.preparer.reset().ok_or(nothing)?),
            ),
        };
        self.strokes.clear();
        Ok((change, result.map_err(refusal)?))
    }

    /// Cuts what the blade of an author has swept since the last cut of its stroke.
    fn extend(
        &mut self,
        author: ParticipantId,
        part: &RestPart,
    ) -> Result<(OperationKind, TopologyCut<'_>), RequestRefusal> {
        let cut = self.strokes.extend(author, part);
        let made = match &cut {
            Some(cut) => self.preparer.cut(convert::part_to_tissue(author, cut)),
            None => Err(CutError::NothingNew),
        };
        self.strokes.note(author, part, made.is_ok());
        match (cut, made) {
            (Some(cut), Ok(made)) => Ok((OperationKind::Cut(cut), made)),
            (_, made) => Err(made.err().map_or(RequestRefusal::NothingCut, refusal)),
        }
    }

    /// A snapshot of the newest topology and its strokes.
    pub fn snapshot(&self) -> TissueReport {
        let topology = self.preparer.topology();
        TissueReport::Snapshot {
            version: topology.version(),
            bytes: snapshot(topology, self.preparer.history()),
        }
    }

    /// Hash of the newest topology.
    pub fn hash(&self) -> TopologyHash {
        TopologyHash(self.preparer.topology().hash().0)
    }

    /// Connected components of the cells. Visits the whole model.
    pub fn components(&self) -> usize {
        self.preparer.topology().components()
    }

    /// Whether every edge of the boundary belongs to exactly two triangles. Visits the whole surface.
    pub fn boundary_closed(&self) -> bool {
        self.preparer.topology().boundary().is_closed()
    }
}

fn refusal(error: CutError) -> RequestRefusal {
    match error {
        CutError::NothingNew => RequestRefusal::NothingCut,
        error => RequestRefusal::CanNotCut(error.to_string()),
    }
}
