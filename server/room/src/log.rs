//! The operation log, its compaction, and its shares.
//!
//! A client that joins or resyncs receives the newest snapshot and the log at once, so both must fit the backlog of one
//! peer, in number and in bytes.
//!
//! ```text
//! snapshot                           16 MiB
//! cuts after it                      4,000 operations and 12 MiB, shared between the authors
//! changes of the playout delay       8,000 operations
//! participants                       compacted: bounded by the rates of joins and resumptions
//! undos, redos and resets after it   900 operations
//! controls of the session            compacted: bounded by their rate and the number of annotations; 1,000 operations
//! ```
//!
//! **Snapshots.** After every [`SNAPSHOT_EVERY`] changes of the topology the cut thread takes a snapshot. It covers the
//! changes up to its version: newcomers receive it instead of them. They stay in the log for a while, for clients that
//! resume. A snapshot that is too large covers nothing, and the space for cuts runs out.
//!
//! **Compaction.** A newcomer knows the present participants from its welcome and needs no operation about one who has
//! left. A resuming client may miss operations of the last minute, because its seat is kept that long. Operations about
//! participants are therefore dropped once they are [`KEPT`] old and superseded: all about a participant who has left, a
//! reconnect with its loss, a restored tool with its demotion. Numbers of operations stay; a gap stands for dropped
//! operations.
//!
//! An operation that gives a new value to one property (a tool, a mute, the camera) is dropped as soon as a later one
//! gives it another: a client that misses the earlier one receives the later one. A value equal to that of the beginning is
//! dropped once it is [`KEPT`] old, and so is an invitation that has expired.
//!
//! **Shares.** A cut is accepted if its author has used less space than remains. One author can therefore use at most
//! half, and every other present participant still cuts. An author who joins again inherits what those who left have
//! used. A snapshot returns all of it.

mod compaction;

use std::sync::Arc;

use palpate_protocol::codec::FRAME_MAX_BYTES;
use palpate_protocol::handshake::{
    SEAT_RETENTION, SNAPSHOT_MAX_BYTES, SNAPSHOT_PIECE_BYTES, SnapshotInfo,
};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::{OperationId, ParticipantId, ServerTime, Span, TopologyHash};

use compaction::about;

/// Changes of the topology between two snapshots. A newcomer repeats little more than these, in 3 to 4 ms each. A
/// snapshot takes 25 ms of the cut thread.
const SNAPSHOT_EVERY: usize = 64;

/// Limit for changes of the playout delay; beyond it the delay is constant.
const DELAYS_MAX: usize = 8_000;

/// Space of the cuts after the snapshot in bytes. Together with it and the other operations it fits the backlog of a
/// peer.
const CUTS_MAX_BYTES: u64 = 12 * 1024 * 1024;

/// Limit for cuts after the snapshot.
const CUTS_MAX: u64 = 4_000;

/// Space of the changes that the snapshot covers, kept for resuming clients, bytes: 2,700 changes.
const COVERED_MAX_BYTES: u64 = 8 * 1024 * 1024;

/// Least space of a cut in bytes, so that one measure bounds number and bytes.
const CUT_MIN_BYTES: u64 = CUTS_MAX_BYTES.div_ceil(CUTS_MAX);

/// Limit for operations about participants. Joins (three classes of 64 and 10 per second, three operations each) and
/// resumptions (64 seats with 8 and 0.2 per second, three operations each) of [`KEPT`] stay below it. With all cuts
/// and changes of the delay it is 24,700, with [`CONTROLS_MAX`] and [`RETURNS_MAX`] 26,600; the transport lets 28,900
/// wait for a peer.
const PARTICIPANTS_MAX: usize = 10_000;

/// Limit for controls of the session. Within [`KEPT`] their rate adds 480 removed annotations or invitations; 64
/// annotations, 64 invitations, as many of their uses and four further values remain.
const CONTROLS_MAX: usize = 1_000;

/// Limit for undos, redos and resets after the snapshot. They are kept like cuts, because later operations depend on
/// them.
const RETURNS_MAX: usize = 900;

/// Age from which superseded operations are dropped: a seat is kept for 60 s, and a lost connection is noticed within
/// 2 s on both sides.
const KEPT: Span = Span::from_micros(SEAT_RETENTION.as_micros() + 10_000_000);

/// Time between two compactions.
const COMPACTION_PERIOD: Span = Span::from_millis(1000);

/// The operations of a session that still matter, in order.
#[derive(Debug, Default)]
pub(crate) struct Log {
    operations: Vec<Arc<Operation>>,
    /// Number of the next operation.
    next: u64,
    /// All operations from this number on are kept.
    complete_from: OperationId,
    delays: usize,
    about_participants: usize,
    controls: usize,
    snapshot: Option<Snapshot>,
    /// Changes after the snapshot.
    uncovered: Changes,
    /// Number of uncovered changes when the latest snapshot was due.
    due_at: usize,
    /// State after the newest change of the topology that was dropped, and the number after it.
    dropped: Option<(OperationId, TopologyState)>,
    next_compaction: ServerTime,
}

/// Version and hash of a topology.
pub type TopologyState = (u32, TopologyHash);

/// A snapshot as newcomers receive it.
#[derive(Debug)]
struct Snapshot {
    info: SnapshotInfo,
    pieces: Vec<Arc<[u8]>>,
}

/// Changes of the topology.
#[derive(Debug, Default)]
struct Changes {
    count: usize,
    /// Undos, redos and resets among them.
    returns: usize,
    /// Space of the cuts among them, bytes.
    cuts_bytes: u64,
}

impl Changes {
    fn note(&mut self, kind: &OperationKind) {
        self.count += 1;
        if matches!(kind, OperationKind::Cut(_)) {
            self.cuts_bytes += space_of(kind);
        } else {
            self.returns += 1;
        }
    }
}

/// Space of a change of the topology: at least its bytes on the wire.
fn space_of(kind: &OperationKind) -> u64 {
    /// Bytes of a blade point, and of all else in a cut.
    const POINT: usize = 28;
    const REST: usize = 96;
    let points = match kind {
        OperationKind::Cut(stroke) => stroke.points.len(),
        _ => 0,
    };
    CUT_MIN_BYTES.max((REST + points * POINT) as u64)
}

impl Log {
    /// Appends an operation with the [next number](Self::next). Returns the space that it uses if it is a cut, bytes.
    pub(crate) fn push(&mut self, operation: Arc<Operation>) -> u64 {
        let kind = &operation.kind;
        let mut space = 0;
        if kind.changes_topology() {
            self.uncovered.note(kind);
            if matches!(kind, OperationKind::Cut(_)) {
                space = space_of(kind);
            }
        } else if matches!(kind, OperationKind::Compensation { .. }) {
            self.delays += 1;
        } else if about(kind).is_some() {
            self.about_participants += 1;
        } else {
            self.controls += 1;
        }
        self.next = operation.id.0 + 1;
        self.operations.push(operation);
        space
    }

    /// The number of the next operation: how many were appended.
    pub(crate) fn next(&self) -> OperationId {
        OperationId(self.next)
    }

    /// The number from which on every operation is kept. A client that lacks earlier ones replays the whole log.
    pub(crate) fn complete_from(&self) -> OperationId {
        self.complete_from
    }

    /// Operations that are kept.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.operations.len()
    }

    /// The topology before the operation with this number; `None` for the uncut one.
    pub(crate) fn state_before(&self, number: OperationId) -> Option<TopologyState> {
        let kept = self.operations[..self.index_of(number)].last();
        let kept = kept.map(|o| (o.id.next(), (o.topology_version_after, o.hash_after)));
        let states = kept.into_iter().chain(self.dropped);
        Some(states.max_by_key(|(after, _)| *after)?.1)
    }

    /// The hash of a version; `None` if no kept operation has it.
    pub(crate) fn hash_of(&self, version: u32) -> Option<TopologyHash> {
        let operations = &self.operations;
        let first = operations.partition_point(|o| o.topology_version_after < version);
        let operation = operations.get(first)?;
        (operation.topology_version_after == version).then_some(operation.hash_after)
    }

    /// The kept operations from this number on.
    pub(crate) fn since(&self, first: OperationId) -> &[Arc<Operation>] {
        &self.operations[self.index_of(first)..]
    }

    /// The operations for a newcomer, who receives the snapshot before them.
    pub(crate) fn for_newcomer(&self) -> Vec<Arc<Operation>> {
        let needed = self.operations.iter().filter(|o| !self.covers(o));
        needed.cloned().collect()
    }

    /// Whether the snapshot contains the effect of an operation.
    fn covers(&self, operation: &Operation) -> bool {
        let covered = self.snapshot.as_ref().map(|s| s.info.topology_version);
        operation.kind.changes_topology()
            && covered.is_some_and(|version| operation.topology_version_after <= version)
    }

    /// The snapshot for newcomers, in pieces.
    pub(crate) fn snapshot(&self) -> Option<(SnapshotInfo, &[Arc<[u8]>])> {
        let snapshot = self.snapshot.as_ref()?;
        Some((snapshot.info, &snapshot.pieces))
    }

    /// Whether the next snapshot is due. It is due once, and after every reset: that of uncut tissue is small and returns
    /// the space of all cuts.
    pub(crate) fn poll_snapshot_due(&mut self) -> bool {
        let is_reset = |o: &Arc<Operation>| o.kind == OperationKind::Reset;
        let is_due = self.uncovered.count >= self.due_at + SNAPSHOT_EVERY
            || self.operations.last().is_some_and(is_reset);
        if is_due {
            self.due_at = self.uncovered.count;
        }
        is_due
    }

    /// Replaces the snapshot by one of a later version. Returns whether it fits a newcomer.
    pub(crate) fn cover(&mut self, topology_version: u32, bytes: &[u8]) -> bool {
        let fitting = u32::try_from(bytes.len()).ok();
        let Some(bytes_total) = fitting.filter(|bytes| *bytes <= SNAPSHOT_MAX_BYTES) else {
            return false;
        };
        self.snapshot = Some(Snapshot {
            info: SnapshotInfo {
                bytes: bytes_total,
                topology_version,
            },
            pieces: bytes.chunks(SNAPSHOT_PIECE_BYTES).map(Arc::from).collect(),
        });
        let mut uncovered = Changes::default();
        for operation in self.operations.iter().rev() {
            if operation.topology_version_after <= topology_version {
                break;
            }
            if operation.kind.changes_topology() {
                uncovered.note(&operation.kind);
            }
        }
        self.uncovered = uncovered;
        self.due_at = 0;
        true
    }

    fn index_of(&self, number: OperationId) -> usize {
        self.operations.partition_point(|o| o.id < number)
    }

    /// Whether an operation is about this participant or was requested by it.
    pub(crate) fn names(&self, who: ParticipantId) -> bool {
        self.operations
            .iter()
            .any(|o| o.author == who || about(&o.kind) == Some(who))
    }

    /// Whether a change of the delay fits.
    pub(crate) fn takes_delay(&self) -> bool {
        self.delays < DELAYS_MAX
    }

    /// Whether a cut fits whose author has used this space, bytes.
    pub(crate) fn takes_cut(&self, used: u64) -> bool {
        let left =
            CUTS_MAX_BYTES.saturating_sub(self.uncovered.cuts_bytes + FRAME_MAX_BYTES as u64);
        used < left
    }

    /// Whether a join or a resumption fits.
    pub(crate) fn takes_seat(&self) -> bool {
        self.about_participants < PARTICIPANTS_MAX
    }

    /// Whether a control fits.
    pub(crate) fn takes_control(&self) -> bool {
        self.controls < CONTROLS_MAX
    }

    /// Whether an undo, a redo or a reset fits.
    pub(crate) fn takes_return(&self) -> bool {
        self.uncovered.returns < RETURNS_MAX
    }
}

#[cfg(test)]
mod tests;
