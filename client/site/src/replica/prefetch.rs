//! Prefetch of cuts: cuts are prepared ahead of their due time.
//!
//! An operation arrives one delay D before its due time. The cut worker cuts the topology and computes the change of the
//! solver's levels; the hand's thread only follows it around the new faces:
//!
//! ```text
//! replica   --Make(operation)-->    cut the topology, compute the change
//!           <--CutMade--            due: the tissues of hand and view follow
//!           --Retire(old)-->        free memory on the worker
//! ```
//!
//! A cut that is late is applied as soon as it is made. Until then the hand uses the old topology.

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_tissue::{
    CutError, CutPreparer, PreparedCut, Retired, Topology, TopologyCut, TopologyHash,
};

use crate::tools::tissue_stroke;

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
    /// The snapshot of the session can not be restored.
    #[error("{0}")]
    Snapshot(String),
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
    /// Free the memory that a cut replaced, which can take milliseconds.
    Retire(Retired),
}

/// A cut that no tissue has adopted yet.
pub struct MadeCut {
    /// For the hand's tissue, if this replica has one.
    pub(crate) hand: Option<PreparedCut>,
    pub(crate) view: Box<PreparedCut>,
}

/// The topology ahead of the replica's.
///
/// Calling order: [`order`](Self::order) for every order; [`work`](Self::work) while [`can_work`](Self::can_work).
pub struct Prefetch {
    preparer: CutPreparer,
    has_hand: bool,
    operations: VecDeque<Operation>,
}

impl Prefetch {
    pub(crate) fn new(preparer: CutPreparer, has_hand: bool) -> Self {
        Self {
            preparer,
            has_hand,
            operations: VecDeque::new(),
        }
    }

    /// Queues an order; [`work`](Self::work) executes it.
    pub fn order(&mut self, order: CutOrder) {
        match order {
            CutOrder::Make(operation) => self.operations.push_back(operation),
            CutOrder::Retire(retired) => drop(retired),
        }
    }

    /// Whether there is work before the next order.
    pub fn can_work(&self) -> bool {
        !self.operations.is_empty()
    }

    /// Makes the next cut. After an error the replica differs from the session.
    pub fn work(&mut self) -> Result<Option<MadeCut>, ReplicaError> {
        match self.operations.pop_front() {
            Some(operation) => self.make(&operation),
            None => Ok(None),
        }
    }

    /// Makes the change of an operation, in log order. `None` for an operation that changes no topology. An error if version or hash differ
    /// from the operation's.
    pub(crate) fn make(&mut self, operation: &Operation) -> Result<Option<MadeCut>, ReplicaError> {
        let preparer = &mut self.preparer;
        let view = change_checked(preparer.topology().version(), operation, |change| {
            let cut = match change {
                OperationKind::Cut(part) => {
                    Some(preparer.prepare(tissue_stroke(operation.author, part)))
                }
                OperationKind::Undone => preparer.undo().map(|cut| Ok(cut.finish())),
                OperationKind::Redone => preparer.redo().map(|cut| cut.map(TopologyCut::finish)),
                OperationKind::Reset => preparer.reset().map(|cut| Ok(cut.finish())),
                _ => None,
            };
            cut.map(|cut| cut.map(|cut| (Arc::clone(cut.topology()), cut)))
        })?;
        Ok(view.map(|view| MadeCut {
            hand: self.has_hand.then(|| self.preparer.repeat(&view)),
            view: Box::new(view),
        }))
    }
}

/// Makes the change of an operation on topology `version`: a cut, an undo, a redo or a reset. `change` returns the
/// topology after it; `None` if there is nothing to change. `None` for other operations. An error if version or hash
/// differ from the operation's.
pub(crate) fn change_checked<T>(
    version: u32,
    operation: &Operation,
    change: impl FnOnce(&OperationKind) -> Option<Result<(Arc<Topology>, T), CutError>>,
) -> Result<Option<T>, ReplicaError> {
    if !operation.kind.changes_topology() {
        return Ok(None);
    }
    let name = || operation.id.to_string();
    if version != operation.topology_version_before {
        return Err(ReplicaError::Version {
            operation: name(),
            expected: operation.topology_version_before,
            found: version,
        });
    }
    let why = |why: String| ReplicaError::Cut {
        operation: name(),
        why,
    };
    let made = change(&operation.kind);
    let made = made.ok_or_else(|| why("this replica has no such cut".to_owned()))?;
    let (topology, made) = made.map_err(|e| why(e.to_string()))?;
    let found = topology.hash();
    if found.0 != operation.hash_after.0 || topology.version() != operation.topology_version_after {
        return Err(ReplicaError::Hash {
            operation: name(),
            expected: operation.hash_after,
            found,
        });
    }
    Ok(Some(made))
}

#[cfg(test)]
mod tests;
