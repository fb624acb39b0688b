//! Cuts, made ahead of the moment in which they are applied.
//!
//! An operation arrives D before the moment in which everybody sees it. Making a cut, and all that the
//! solvers have to know of it, takes tens of milliseconds; a hand's force is believed for no longer than
//! that. So it is done beside the replica while the operation waits, and taken over when its moment has
//! come.

mod thread;

use std::sync::Arc;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_tissue::{CutOutcome, Follower, Successor, Topology, TopologyHash, cut};

pub(crate) use thread::AheadThread;

use crate::convert::tissue_stroke;

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
    /// What makes the cuts has ended, or was taken elsewhere.
    #[error("{operation} can not be applied: nothing is here any more that makes cuts")]
    Ended {
        /// Which.
        operation: String,
    },
}

/// The topology ahead of a replica's.
pub struct Ahead {
    topology: Arc<Topology>,
    follower: Follower,
    with_hand: bool,
}

/// A cut, ready to be taken over.
pub struct ReadyCut {
    pub(crate) topology: Arc<Topology>,
    pub(crate) outcome: CutOutcome,
    /// For the side of the hand, if there is one.
    pub(crate) haptic: Option<Successor>,
    pub(crate) view: Successor,
}

impl Ahead {
    pub(crate) fn new(topology: &Arc<Topology>, follower: Follower, with_hand: bool) -> Self {
        Self {
            topology: Arc::clone(topology),
            follower,
            with_hand,
        }
    }

    /// Makes the cut of an operation, in the order of the log. `None` when it is none: nothing else
    /// changes the tissue. Version and hash are then the operation's, or it is an error.
    pub fn make(&mut self, operation: &Operation) -> Result<Option<ReadyCut>, ReplicaError> {
        let Some(outcome) = cut_as_told(&mut self.topology, operation)? else {
            return Ok(None);
        };
        self.follower.follow(&self.topology, &outcome.touched);
        let successor = || self.follower.successor(&self.topology);
        Ok(Some(ReadyCut {
            haptic: self.with_hand.then(successor),
            view: successor(),
            topology: Arc::clone(&self.topology),
            outcome,
        }))
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
