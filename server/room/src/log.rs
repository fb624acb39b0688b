//! The operations log, and how much of it is left for whom.
//!
//! Every newcomer is sent the whole log at once, and so is who makes a copy anew: it has to fit what may
//! wait for one peer, in number and in bytes. What a person can do without is refused first, and what
//! undoes something is always written:
//!
//! ```text
//! changes of the artificial delay            up to  8,000 operations
//! cuts, other tools, tools that are lifted   up to 16,000 operations and 28 MiB
//! somebody joins or comes back               up to 18,000 operations and 30 MiB
//! somebody leaves, is away, gets the tool back, the session starts: always; at most three per seat that
//!                                            is taken are left to be written
//! ```

use std::sync::Arc;

use palpate_protocol::codec::{FRAME_MAX_BYTES, encode_frame};
use palpate_protocol::operation::Operation;
use palpate_protocol::request::ServerMessage;
use palpate_protocol::session::STREAM_BACKLOG_MAX_BYTES;

/// Changes of the delay end with so many operations: it stays as it is, and half of the log is left for
/// the tissue. At four changes a second, which no network asks for all the time, this is half an hour.
const DELAYS_MAX: usize = 8_000;

/// What is done to the tissue ends with so many operations. The session is to be saved as a model of its
/// own then.
const OPERATIONS_MAX: usize = 16_000;

/// Nobody comes any more with so many operations; the transport lets 20,000 wait for a peer.
const GREETED_MAX: usize = 18_000;

/// Left of what may wait for a peer where nothing is done to the tissue any more: two thousand operations
/// of the longest that are no stroke, with a name of 64 B and a tool, take half of it.
const BYTES_LEFT_FOR_SEATS: usize = 4 * 1024 * 1024;

/// Left of it where nobody comes any more: a welcome, and what is always written.
const BYTES_LEFT_FOR_ENDS: usize = 2 * 1024 * 1024;

/// The operations of a session.
#[derive(Debug, Default)]
pub(crate) struct Log {
    operations: Vec<Arc<Operation>>,
    bytes: usize,
}

impl Log {
    /// Adds the next one.
    pub(crate) fn push(&mut self, operation: Arc<Operation>) {
        let message = ServerMessage::Operation(operation.as_ref().clone());
        // One that has no frame is sent to nobody, and counts as the longest.
        self.bytes += encode_frame(&message).map_or(FRAME_MAX_BYTES, |frame| frame.len());
        self.operations.push(operation);
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.operations.len()
    }

    /// The one of that number.
    pub(crate) fn get(&self, number: usize) -> Option<&Arc<Operation>> {
        self.operations.get(number)
    }

    /// Those from a number on.
    pub(crate) fn since(&self, first: usize) -> &[Arc<Operation>] {
        self.operations.get(first..).unwrap_or_default()
    }

    /// Whether the delay may change once more.
    pub(crate) fn takes_delay(&self) -> bool {
        self.len() < DELAYS_MAX && self.takes_bytes(BYTES_LEFT_FOR_SEATS)
    }

    /// Whether something may be done to the tissue, with the tools or to somebody's tool.
    pub(crate) fn takes_work(&self) -> bool {
        self.len() < OPERATIONS_MAX && self.takes_bytes(BYTES_LEFT_FOR_SEATS)
    }

    /// Whether somebody may join or come back.
    pub(crate) fn takes_seat(&self) -> bool {
        self.len() < GREETED_MAX && self.takes_bytes(BYTES_LEFT_FOR_ENDS)
    }

    /// Whether the longest operation leaves so much of what may wait for a peer.
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
    fn the_longest_strokes_end_while_a_newcomer_can_still_be_sent_them_all() {
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
    fn the_delay_ends_first_then_work_then_seats() {
        let back = operation(OperationKind::Back {
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
        assert_eq!(ends, [DELAYS_MAX, OPERATIONS_MAX, GREETED_MAX]);
    }
}
