//! The thread that makes cuts while the replica's goes on serving the hand.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use palpate_protocol::operation::Operation;

use super::{Ahead, ReadyCut, ReplicaError};
use crate::realtime::lower_priority_of_this_thread;

/// How much it gives way to the replica, which serves the hand.
const NICE: i32 = 4;

/// A thread that makes cuts in the order in which it is told of them. It ends with this.
pub(crate) struct AheadThread {
    operations: Sender<Operation>,
    made: Receiver<Result<ReadyCut, ReplicaError>>,
}

impl AheadThread {
    pub(crate) fn spawn(mut ahead: Ahead) -> std::io::Result<Self> {
        let (operations, told) = channel::<Operation>();
        let (tell, made) = channel();
        std::thread::Builder::new()
            .name("cuts".to_owned())
            .spawn(move || {
                if !lower_priority_of_this_thread(NICE) {
                    tracing::debug!("the thread of the cuts keeps its priority");
                }
                for operation in told {
                    let Some(made) = ahead.make(&operation).transpose() else {
                        continue;
                    };
                    // After an error the copy is not the session's any more.
                    let last = made.is_err();
                    if tell.send(made).is_err() || last {
                        break;
                    }
                }
            })?;
        Ok(Self { operations, made })
    }

    /// Has a cut made.
    pub(crate) fn make(&self, operation: Operation) -> Result<(), ReplicaError> {
        let ended = |e: std::sync::mpsc::SendError<Operation>| ReplicaError::Ended {
            operation: e.0.id.to_string(),
        };
        self.operations.send(operation).map_err(ended)
    }

    /// The next cut that is made, if there is one; an error when the thread has ended by itself, so that
    /// no operation waits for ever.
    pub(crate) fn poll(&self) -> Result<Option<ReadyCut>, ReplicaError> {
        match self.made.try_recv() {
            Ok(made) => made.map(Some),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(ReplicaError::Ended {
                operation: "a cut".to_owned(),
            }),
        }
    }
}
