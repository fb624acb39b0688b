//! Cuts, made ahead of the moment in which they are applied.
//!
//! An operation arrives D before its due time. Making a cut takes tens of milliseconds: the topology, the bricks and
//! levels, every force, and some steps until a hand's solver is settled again. The thread of the hand has 2 ms. So all of
//! it is done by a machine beside the replica, and the hand's thread only exchanges pointers:
//!
//! ```text
//! replica   --Make(operation)-->    the topology and its structure are made
//!           <--Made(room)--
//!           --Prepare(state)-->     a copy of the hand's state is continued on the new topology, and solved
//!           --Follow(tools)-->      ... for the newest tools, in every step of the hand
//!           --HandOver-->
//!           <--Ready(cut)--         due: the replica exchanges its hand's side
//!           --Retire(old)-->        memory is freed here as well
//! ```
//!
//! A cut that is not ready at its due time is applied when it is; until then the hand goes on with the old topology.

mod thread;

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_tissue::{
    Budget, CutOutcome, Follower, SolverState, Successor, Tool, Topology, TopologyHash, cut,
};

pub(crate) use thread::AheadThread;

use crate::convert::tissue_stroke;
use crate::replica::{HAPTIC_TOLERANCE, ITERATIONS, Side};
use crate::view::ViewCut;

/// Cuts whose topology may be made before the first of them is applied: each holds two solvers' memory.
const MADE_MAX: usize = 2;

/// Why an operation can not be applied: this copy is not the session's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReplicaError {
    /// The operation is for another topology.
    #[error("{operation} is for topology version {expected}, this one has version {found}")]
    Version {
        /// Which.
        operation: String,
        /// What it is for.
        expected: u32,
        /// What is here.
        found: u32,
    },
    /// The cut can not be made here.
    #[error("{operation} can not be applied: {why}")]
    Cut {
        /// Which.
        operation: String,
        /// What the tissue said.
        why: String,
    },
    /// The result is another.
    #[error("after {operation} the topology hash is {found}, the server's is {expected}")]
    Hash {
        /// Which.
        operation: String,
        /// The server's.
        expected: palpate_protocol::TopologyHash,
        /// One's own.
        found: TopologyHash,
    },
    /// The cut worker has stopped.
    #[error("{operation} can not be applied: the cut worker has stopped; rejoin the session")]
    Ended {
        /// Which.
        operation: String,
    },
}

/// Work for the machine that makes cuts.
pub enum CutOrder {
    /// Make the cut of an operation, in the order of the log.
    Make(Operation),
    /// Continue the hand's side on the topology of the first cut that is made: its state, and its tools.
    Prepare(Box<SolverState>, Vec<Tool>),
    /// The tools of the hand's newest step.
    Follow(Vec<Tool>),
    /// Hand the first cut over as soon as it is settled.
    HandOver,
    /// Free what a cut replaced.
    Retire(Retired),
}

/// Result of the machine that makes cuts.
pub enum CutNews {
    /// The topology of the next cut is made; memory for the state of the hand's side.
    Made(Box<SolverState>),
    /// The next cut is ready to be applied.
    Ready(ReadyCut),
}

/// A cut with its topology, before any solver has taken it over.
pub(crate) struct MadeCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) outcome: CutOutcome,
    /// For the side of the hand, if there is one.
    pub(crate) hand: Option<Successor>,
    pub(crate) view: Successor,
}

/// A cut, ready to be applied.
pub struct ReadyCut {
    pub(crate) topology: Arc<Topology>,
    /// The side of the hand, solved, if there is one.
    pub(crate) hand: Option<Box<Side>>,
    pub(crate) view: Box<ViewCut>,
}

/// Memory that a cut replaced. To free it takes milliseconds, so it is not done on the thread of the hand.
pub struct Retired {
    pub(crate) topology: Arc<Topology>,
    pub(crate) hand: Option<Box<Side>>,
}

/// The side of the hand, on its way to the topology of the first of the cuts that are made.
struct Preparation {
    /// What it continues, until it does.
    state: Option<Box<SolverState>>,
    side: Option<Box<Side>>,
    tools: Vec<Tool>,
    is_settled: bool,
    /// Whether the tools are those of the last step.
    is_current: bool,
    is_wanted: bool,
}

/// The topology ahead of a replica's, and the side of its hand.
///
/// Calling order: [`order`](Self::order) as orders come; [`work`](Self::work) while it [can](Self::can_work).
pub struct Ahead {
    topology: Arc<Topology>,
    follower: Follower,
    has_hand: bool,
    operations: VecDeque<Operation>,
    made: VecDeque<MadeCut>,
    preparation: Option<Preparation>,
}

impl Ahead {
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

    /// Takes an order; nothing of it is done before [`work`](Self::work).
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

    /// Whether there is anything to do before the next order.
    pub fn can_work(&self) -> bool {
        match &self.preparation {
            Some(p) => p.can_step() || p.is_wanted,
            None => !self.operations.is_empty() && self.made.len() < MADE_MAX,
        }
    }

    /// Does the next piece of work, of tens of milliseconds at most. After an error the copy is not the session's any
    /// more.
    pub fn work(&mut self) -> Result<Option<CutNews>, ReplicaError> {
        let Some(preparation) = &mut self.preparation else {
            return self.make_next();
        };
        if preparation.can_step() {
            if let Some(made) = self.made.front_mut() {
                preparation.step(made);
            } else {
                // It was ordered before anything was made.
                self.preparation = None;
            }
        } else if preparation.is_wanted {
            let side = preparation.side.take();
            self.preparation = None;
            let made = self.made.pop_front();
            return Ok(made.map(|made| CutNews::Ready(made.ready(side))));
        }
        Ok(None)
    }

    fn make_next(&mut self) -> Result<Option<CutNews>, ReplicaError> {
        let Some(operation) = self.operations.pop_front() else {
            return Ok(None);
        };
        let Some(made) = self.make(&operation)? else {
            return Ok(None);
        };
        if !self.has_hand {
            return Ok(Some(CutNews::Ready(made.ready(None))));
        }
        self.made.push_back(made);
        Ok(Some(CutNews::Made(Box::new(self.follower.room()))))
    }

    /// Makes the cut of an operation, in the order of the log. `None` when it is none: nothing else
    /// changes the tissue. Version and hash are then the operation's, or it is an error.
    pub(crate) fn make(&mut self, operation: &Operation) -> Result<Option<MadeCut>, ReplicaError> {
        let Some(outcome) = cut_as_told(&mut self.topology, operation)? else {
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
    /// Whether a step would bring the side nearer to its equilibrium. One that is wanted follows no further.
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
        // A step without a tool that touches anything has nothing to settle.
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

/// Makes the cut of an operation in a topology. `None` when it is none; version and hash are then the
/// operation's, or it is an error.
pub(crate) fn cut_as_told(
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
