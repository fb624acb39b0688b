//! Prefetch of cuts: cuts are prepared ahead of their due time.
//!
//! An operation arrives one delay D before its due time. Preparing a cut takes tens of milliseconds: topology,
//! bricks, multigrid levels, forces, and some steps until the hand's solver has settled. The hand's thread has 4 ms.
//! The cut worker prepares everything; the hand's thread only exchanges pointers:
//!
//! ```text
//! replica   --Make(operation)-->    build topology and solver structure
//!           <--Made(room)--
//!           --Prepare(state)-->     continue a copy of the hand's state on the new topology, and solve
//!           --Follow(tools)-->      ... for the newest tools, at every step of the hand
//!           --HandOver-->
//!           <--Ready(cut)--         due: the replica exchanges the hand's side
//!           --Retire(old)-->        free memory on the worker
//! ```
//!
//! A cut that is late is applied as soon as it is ready. Until then the hand uses the old topology.

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_tissue::{
    Budget, CutOutcome, Follower, SolverState, Successor, Tool, Topology, TopologyHash, cut,
};

use super::view::ViewCut;
use super::{HAPTIC_TOLERANCE, ITERATIONS, Side};
use crate::tools::tissue_stroke;

/// Maximum number of cuts prepared in advance: each holds the memory of two solvers.
const MADE_MAX: usize = 2;

/// Reason why an operation can not be applied: this replica differs from the session's tissue.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReplicaError {
    /// The operation is for another topology.
    #[error("{operation} is for topology version {expected}, this one has version {found}")]
    Version {
        /// Operation id.
        operation: String,
        /// Topology version required by the operation.
        expected: u32,
        /// Topology version of this replica.
        found: u32,
    },
    /// The cut failed on this replica.
    #[error("{operation} can not be applied: {why}")]
    Cut {
        /// Operation id.
        operation: String,
        /// Error of the tissue crate.
        why: String,
    },
    /// The resulting topology hash differs from the server's.
    #[error("after {operation} the topology hash is {found}, the server's is {expected}")]
    Hash {
        /// Operation id.
        operation: String,
        /// Hash of the server.
        expected: palpate_protocol::TopologyHash,
        /// Hash of this replica.
        found: TopologyHash,
    },
    /// The cut worker has stopped.
    #[error("{operation} can not be applied: the cut worker has stopped; rejoin the session")]
    Ended {
        /// Operation id.
        operation: String,
    },
}

/// Orders to the cut worker.
pub enum CutOrder {
    /// Make the cut of an operation, in log order.
    Make(Operation),
    /// Continue the hand's state and tools on the topology of the first prepared cut.
    Prepare(Box<SolverState>, Vec<Tool>),
    /// Tools of the hand's newest step.
    Follow(Vec<Tool>),
    /// Hand over the first cut as soon as it has settled.
    HandOver,
    /// Free the memory that a cut replaced.
    Retire(Retired),
}

/// Results of the cut worker.
pub enum CutWorkerEvent {
    /// The topology of the next cut is built; carries memory for the hand's solver state.
    Made(Box<SolverState>),
    /// The next cut is ready to be applied.
    Ready(ReadyCut),
}

/// A cut with its topology, before any solver has adopted it.
pub(crate) struct MadeCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) outcome: CutOutcome,
    /// For the hand's side, if this replica has one.
    pub(crate) hand: Option<Successor>,
    pub(crate) view: Successor,
}

/// A cut that is ready to be applied.
pub struct ReadyCut {
    pub(crate) topology: Arc<Topology>,
    /// The hand's side, if this replica has one.
    pub(crate) hand: Option<Box<Side>>,
    pub(crate) view: Box<ViewCut>,
}

/// Memory that a cut replaced. Freeing it takes milliseconds, so the worker does it.
pub struct Retired {
    pub(crate) topology: Arc<Topology>,
    pub(crate) hand: Option<Box<Side>>,
}

/// The hand's side, being moved to the topology of the first prepared cut.
struct Preparation {
    /// State to continue; `None` once it is continued.
    state: Option<Box<SolverState>>,
    side: Option<Box<Side>>,
    tools: Vec<Tool>,
    is_settled: bool,
    /// Whether the latest step used the newest tools.
    is_current: bool,
    is_wanted: bool,
}

/// The topology ahead of the replica's, and the hand's side on it.
///
/// Calling order: [`order`](Self::order) for every order; [`work`](Self::work) while [`can_work`](Self::can_work).
pub struct Prefetch {
    topology: Arc<Topology>,
    follower: Follower,
    has_hand: bool,
    operations: VecDeque<Operation>,
    made: VecDeque<MadeCut>,
    preparation: Option<Preparation>,
}

impl Prefetch {
    pub(crate) fn new(topology: &Arc<Topology>, follower: Follower, has_hand: bool) -> Self {
        Self {
            topology: Arc::clone(topology),
            follower,
            has_hand,
            operations: VecDeque::new(),
            made: VecDeque::new(),
            preparation: None,
        }
    }

    /// Queues an order; [`work`](Self::work) executes it.
    pub fn order(&mut self, order: CutOrder) {
        match order {
            CutOrder::Make(operation) => self.operations.push_back(operation),
            CutOrder::Prepare(state, tools) => {
                self.preparation = Some(Preparation {
                    state: Some(state),
                    side: None,
                    tools,
                    is_settled: false,
                    is_current: false,
                    is_wanted: false,
                });
            }
            CutOrder::Follow(tools) => {
                if let Some(preparation) = &mut self.preparation {
                    preparation.tools = tools;
                    preparation.is_current = false;
                }
            }
            CutOrder::HandOver => {
                if let Some(preparation) = &mut self.preparation {
                    preparation.is_wanted = true;
                }
            }
            CutOrder::Retire(Retired { topology, hand }) => drop((topology, hand)),
        }
    }

    /// Whether there is work before the next order.
    pub fn can_work(&self) -> bool {
        match &self.preparation {
            Some(p) => p.can_step() || p.is_wanted,
            None => !self.operations.is_empty() && self.made.len() < MADE_MAX,
        }
    }

    /// Does the next piece of work, tens of milliseconds at most. After an error the replica differs from the
    /// session.
    pub fn work(&mut self) -> Result<Option<CutWorkerEvent>, ReplicaError> {
        let Some(preparation) = &mut self.preparation else {
            return self.make_next();
        };
        if preparation.can_step() {
            if let Some(made) = self.made.front_mut() {
                preparation.step(made);
            } else {
                // The order came before any cut was made.
                self.preparation = None;
            }
        } else if preparation.is_wanted {
            let side = preparation.side.take();
            self.preparation = None;
            let made = self.made.pop_front();
            return Ok(made.map(|made| CutWorkerEvent::Ready(made.ready(side))));
        }
        Ok(None)
    }

    fn make_next(&mut self) -> Result<Option<CutWorkerEvent>, ReplicaError> {
        let Some(operation) = self.operations.pop_front() else {
            return Ok(None);
        };
        let Some(made) = self.make(&operation)? else {
            return Ok(None);
        };
        if !self.has_hand {
            return Ok(Some(CutWorkerEvent::Ready(made.ready(None))));
        }
        self.made.push_back(made);
        Ok(Some(CutWorkerEvent::Made(Box::new(self.follower.room()))))
    }

    /// Makes the cut of an operation, in log order. `None` for other operations. An error if version or hash differ
    /// from the operation's.
    pub(crate) fn make(&mut self, operation: &Operation) -> Result<Option<MadeCut>, ReplicaError> {
        let Some(outcome) = cut_checked(&mut self.topology, operation)? else {
            return Ok(None);
        };
        self.follower.follow(&self.topology, &outcome.touched);
        let successor = || self.follower.successor(&self.topology);
        Ok(Some(MadeCut {
            hand: self.has_hand.then(successor),
            view: successor(),
            topology: Arc::clone(&self.topology),
            outcome,
        }))
    }
}

impl Preparation {
    /// Whether a step would bring the side nearer to equilibrium. A side that is to be handed over follows no further
    /// tools.
    fn can_step(&self) -> bool {
        !self.is_settled || !(self.is_current || self.is_wanted)
    }

    /// Continues the copied state on the topology of a cut, or makes one more step there.
    fn step(&mut self, made: &mut MadeCut) {
        let topology = &made.topology;
        if let Some((state, successor)) = self.state.take().zip(made.hand.take()) {
            self.side = Some(Box::new(Side::resume(
                *state,
                topology,
                &made.outcome,
                successor,
            )));
        }
        let Some(side) = &mut self.side else {
            (self.is_settled, self.is_current) = (true, true);
            return;
        };
        let budget = Budget {
            near: true,
            iterations: ITERATIONS,
            tolerance: HAPTIC_TOLERANCE,
            stop: None,
        };
        side.solver
            .step(topology, &mut side.shape, &self.tools, budget);
        self.is_current = true;
        // Without a contact there is nothing to settle.
        self.is_settled = !side.solver.is_settling();
    }
}

impl MadeCut {
    fn ready(self, hand: Option<Box<Side>>) -> ReadyCut {
        ReadyCut {
            hand,
            view: Box::new(ViewCut {
                topology: Arc::clone(&self.topology),
                outcome: self.outcome,
                successor: self.view,
            }),
            topology: self.topology,
        }
    }
}

/// Makes the cut of an operation in a topology. `None` for other operations. An error if version or hash differ from
/// the operation's.
pub(crate) fn cut_checked(
    topology: &mut Arc<Topology>,
    operation: &Operation,
) -> Result<Option<CutOutcome>, ReplicaError> {
    let OperationKind::Cut(stroke) = &operation.kind else {
        return Ok(None);
    };
    let name = || operation.id.to_string();
    if topology.version() != operation.topology_version_before {
        return Err(ReplicaError::Version {
            operation: name(),
            expected: operation.topology_version_before,
            found: topology.version(),
        });
    }
    let topology = Arc::make_mut(topology);
    let outcome = cut(topology, &tissue_stroke(stroke)).map_err(|e| ReplicaError::Cut {
        operation: name(),
        why: e.to_string(),
    })?;
    let found = topology.hash();
    if found.0 != operation.hash_after.0 || topology.version() != operation.topology_version_after {
        return Err(ReplicaError::Hash {
            operation: name(),
            expected: operation.hash_after,
            found,
        });
    }
    Ok(Some(outcome))
}

#[cfg(test)]
mod tests;
