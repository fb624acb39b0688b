//! The operation log and its limits by kind of operation.
//!
//! A client that joins or resyncs receives the whole log at once, so the log must fit the backlog of one peer, in
//! number and in bytes. The least necessary operations are rejected first. Operations that end something are always
//! written:
//!
//! ```text
//! change of the playout delay                     up to  8,000 operations
//! cut, demotion                                   up to 16,000 operations and 28 MiB
//! join, resumption with its tool change           up to 18,000 operations and 30 MiB
//! leave, disconnect, restored tool, session start always; at most three per occupied seat are outstanding
//! ```

use std::sync::Arc;

use palpate_protocol::codec::{FRAME_MAX_BYTES, encode_frame};
use palpate_protocol::operation::Operation;
use palpate_protocol::request::ServerMessage;
use palpate_protocol::session::STREAM_BACKLOG_MAX_BYTES;

/// Limit for changes of the playout delay; beyond it the delay is constant. Half of the log is left for the tissue.
/// At a constant four changes per second, more than networks need, this is half an hour.
const DELAYS_MAX: usize = 8_000;

/// Limit for cuts and demotions. The host should then save the tissue as a new model.
const OPERATIONS_MAX: usize = 16_000;

/// Limit for joins and resumptions. The transport lets 20,000 operations wait for a peer.
const JOINS_MAX: usize = 18_000;

/// Bytes of a peer's backlog reserved beyond cuts: two thousand of the longest operations without stroke (a name of
/// 64 B and a tool) take half of it.
const BYTES_LEFT_FOR_SEATS: usize = 4 * 1024 * 1024;

/// Bytes reserved beyond joins: a welcome and the operations that are always written.
const BYTES_LEFT_FOR_ENDS: usize = 2 * 1024 * 1024;

/// The operations of a session.
#[derive(Debug, Default)]
pub(crate) struct Log {
    operations: Vec<Arc<Operation>>,
    bytes: usize,
}

impl Log {
    /// Appends an operation.
    pub(crate) fn push(&mut self, operation: Arc<Operation>) {
        let message = ServerMessage::Operation(operation.as_ref().clone());
        // An operation that fits no frame is never sent, and counts as the longest.
        self.bytes += encode_frame(&message).map_or(FRAME_MAX_BYTES, |frame| frame.len());
        self.operations.push(operation);
    }

    /// Number of operations.
    pub(crate) fn len(&self) -> usize {
        self.operations.len()
    }

    /// The operation with this number.
    pub(crate) fn get(&self, number: usize) -> Option<&Arc<Operation>> {
        self.operations.get(number)
    }

    /// The operations from this number on.
    pub(crate) fn since(&self, first: usize) -> &[Arc<Operation>] {
        self.operations.get(first..).unwrap_or_default()
    }

    /// Whether a change of the delay fits.
    pub(crate) fn takes_delay(&self) -> bool {
        self.len() < DELAYS_MAX && self.takes_bytes(BYTES_LEFT_FOR_SEATS)
    }

    /// Whether a cut or a demotion fits.
    pub(crate) fn takes_work(&self) -> bool {
        self.len() < OPERATIONS_MAX && self.takes_bytes(BYTES_LEFT_FOR_SEATS)
    }

    /// Whether a join or a resumption fits.
    pub(crate) fn takes_seat(&self) -> bool {
        self.len() < JOINS_MAX && self.takes_bytes(BYTES_LEFT_FOR_ENDS)
    }

    /// Whether the longest operation leaves `left` bytes of a peer's backlog.
    fn takes_bytes(&self, left: usize) -> bool {
        self.bytes + FRAME_MAX_BYTES + left <= STREAM_BACKLOG_MAX_BYTES
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::operation::{BladePoint, CutStroke, OperationKind, STROKE_MAX_POINTS};
    use palpate_protocol::{OperationId, ParticipantId, ServerTime, TopologyHash};

    use super::*;

    fn operation(kind: OperationKind) -> Arc<Operation> {
        Arc::new(Operation {
            id: OperationId(u64::MAX),
            at: ServerTime::from_micros(i64::MAX),
            author: ParticipantId(u16::MAX),
            topology_version_before: u32::MAX,
            topology_version_after: u32::MAX,
            hash_after: TopologyHash(u64::MAX),
            kind,
        })
    }

    #[test]
    fn a_log_full_of_longest_strokes_still_fits_a_new_client() {
        let blade = BladePoint {
            tip_m: [0.123; 3],
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.03,
        };
        let stroke = operation(OperationKind::Cut(CutStroke {
            points: vec![blade; STROKE_MAX_POINTS],
            width_m: 0.001,
        }));
        let mut log = Log::default();
        while log.takes_work() {
            log.push(Arc::clone(&stroke));
        }
        assert!(log.len() > 900, "{} strokes", log.len());
        assert!(log.takes_seat());
        assert!(log.bytes + BYTES_LEFT_FOR_SEATS <= STREAM_BACKLOG_MAX_BYTES);
    }

    #[test]
    fn delay_changes_are_rejected_first_then_cuts_then_joins() {
        let back = operation(OperationKind::Reconnected {
            participant: ParticipantId(1),
        });
        let mut log = Log::default();
        let mut ends = [0; 3];
        while log.takes_seat() {
            let takes = [log.takes_delay(), log.takes_work(), log.takes_seat()];
            for (end, _) in ends.iter_mut().zip(takes).filter(|(_, takes)| *takes) {
                *end = log.len() + 1;
            }
            log.push(Arc::clone(&back));
        }
        assert_eq!(ends, [DELAYS_MAX, OPERATIONS_MAX, JOINS_MAX]);
    }
}
