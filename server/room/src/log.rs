//! The operation log, its compaction, and its shares.
//!
//! A client that joins or resyncs receives the whole log at once, so the log must fit the backlog of one peer, in
//! number and in bytes.
//!
//! ```text
//! cuts                               7,000 operations and 28 MiB, shared between the authors
//! changes of the playout delay       8,000 operations
//! participants                       compacted: bounded by the rates of joins and resumptions
//! undos, redos and resets            900 operations
//! controls of the session            compacted: bounded by their rate and the number of annotations; 1,000 operations
//! ```
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
//! used.

use std::collections::BTreeSet;
use std::sync::Arc;

use palpate_protocol::codec::{FRAME_MAX_BYTES, encode_frame};
use palpate_protocol::handshake::SEAT_RETENTION;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::ServerMessage;
use palpate_protocol::{OperationId, ParticipantId, ServerTime, Span};

/// Limit for changes of the playout delay; beyond it the delay is constant.
const DELAYS_MAX: usize = 8_000;

/// Space of all cuts in bytes. Together with the other operations it fits the backlog of a peer.
const CUTS_MAX_BYTES: u64 = 28 * 1024 * 1024;

/// Limit for cuts.
const CUTS_MAX: u64 = 7_000;

/// Least space of a cut in bytes, so that one measure bounds number and bytes.
const CUT_MIN_BYTES: u64 = CUTS_MAX_BYTES.div_ceil(CUTS_MAX);

/// Limit for operations about participants. Joins (three classes of 64 and 10 per second, three operations each) and
/// resumptions (64 seats with 8 and 0.2 per second, three operations each) of [`KEPT`] stay below it. With cuts and
/// changes of the delay it is 25,000, with [`CONTROLS_MAX`] and [`RETURNS_MAX`] 26,900; the transport lets 28,900
/// wait for a peer.
const PARTICIPANTS_MAX: usize = 10_000;

/// Limit for controls of the session. Within [`KEPT`] their rate adds 480 removed annotations or invitations; 64
/// annotations, 64 invitations, as many of their uses and four further values remain.
const CONTROLS_MAX: usize = 1_000;

/// Limit for undos, redos and resets. They are kept like cuts, because later operations depend on them.
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
    returns: usize,
    /// Space used by cuts, bytes.
    cuts_bytes: u64,
    next_compaction: ServerTime,
}

impl Log {
    /// Appends an operation with the [next number](Self::next). Returns the space that it uses if it is a cut, bytes.
    pub(crate) fn push(&mut self, operation: Arc<Operation>) -> u64 {
        let space = match &operation.kind {
            OperationKind::Cut(_) => {
                let message = ServerMessage::Operation(operation.as_ref().clone());
                // An operation that fits no frame is never sent, and counts as the longest.
                let bytes = encode_frame(&message).map_or(FRAME_MAX_BYTES, |frame| frame.len());
                CUT_MIN_BYTES.max(bytes as u64)
            }
            OperationKind::Compensation { .. } => {
                self.delays += 1;
                0
            }
            OperationKind::Reset | OperationKind::Undone | OperationKind::Redone => {
                self.returns += 1;
                0
            }
            kind if about(kind).is_some() => {
                self.about_participants += 1;
                0
            }
            _ => {
                self.controls += 1;
                0
            }
        };
        self.cuts_bytes += space;
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

    /// When the newest kept operation takes effect.
    pub(crate) fn newest_at(&self) -> Option<ServerTime> {
        self.operations.last().map(|o| o.at)
    }

    /// Operations that are kept.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.operations.len()
    }

    /// The last kept operation before this number.
    pub(crate) fn last_before(&self, number: OperationId) -> Option<&Arc<Operation>> {
        self.operations[..self.index_of(number)].last()
    }

    /// The kept operations from this number on.
    pub(crate) fn since(&self, first: OperationId) -> &[Arc<Operation>] {
        &self.operations[self.index_of(first)..]
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
        let left = CUTS_MAX_BYTES.saturating_sub(self.cuts_bytes + FRAME_MAX_BYTES as u64);
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
        self.returns < RETURNS_MAX
    }

    /// The freeze that has not ended.
    fn freeze_in_force(&self) -> Option<OperationId> {
        let newest = self.operations.iter().rev().find_map(|o| match o.kind {
            OperationKind::Frozen { is_frozen, .. } => Some((o.id, is_frozen)),
            _ => None,
        });
        newest.filter(|(_, is_frozen)| *is_frozen).map(|(id, _)| id)
    }

    /// Drops operations that no longer matter, once per [`COMPACTION_PERIOD`].
    pub(crate) fn compact(&mut self, now: ServerTime) {
        if now < self.next_compaction {
            return;
        }
        self.next_compaction = now + COMPACTION_PERIOD;
        let mut superseding = Superseding {
            frozen_by: self.freeze_in_force(),
            ..Superseding::default()
        };
        let mut fates: Vec<Fate> = self
            .operations
            .iter()
            .rev()
            .map(|o| superseding.fate(o, now))
            .collect();
        fates.reverse();
        let mut fates = fates.into_iter();
        self.operations.retain(|o| {
            let fate = fates.next().unwrap_or(Fate::Kept);
            if fate == Fate::Kept {
                return true;
            }
            if fate == Fate::Dropped {
                self.complete_from = self.complete_from.max(o.id.next());
            }
            if about(&o.kind).is_some() {
                self.about_participants -= 1;
            } else {
                self.controls -= 1;
            }
            false
        });
    }
}

/// Decision of the compaction about an operation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    /// It still matters.
    Kept,
    /// A later operation contains its effect.
    Replaced,
    /// It no longer matters, but a client that lacks the operations around it needs the whole log.
    Dropped,
}

/// A property of the session that has its newest value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Property {
    Tool(ParticipantId),
    Mute(ParticipantId),
    ForceLimit(ParticipantId),
    Emulation(ParticipantId),
    Freeze,
    Access,
    CompensationMode,
    Camera,
    Annotation(u32),
    Invitation(u32),
}

/// The property that an operation sets, and whether it sets the value of the beginning.
fn sets(kind: &OperationKind) -> Option<(Property, bool)> {
    Some(match kind {
        OperationKind::ToolChanged { participant, .. } => (Property::Tool(*participant), false),
        OperationKind::Muted {
            participant,
            is_muted,
        } => (Property::Mute(*participant), !is_muted),
        OperationKind::ForceLimit {
            participant,
            newtons,
        } => (Property::ForceLimit(*participant), newtons.is_none()),
        OperationKind::Emulated {
            participant,
            emulation,
        } => (Property::Emulation(*participant), emulation.is_none()),
        OperationKind::Frozen { is_frozen, .. } => (Property::Freeze, !is_frozen),
        OperationKind::Access { .. } => (Property::Access, false),
        OperationKind::CompensationMode { .. } => (Property::CompensationMode, false),
        OperationKind::CameraShown(_) => (Property::Camera, false),
        OperationKind::Annotated(annotation) => (Property::Annotation(annotation.id), false),
        OperationKind::AnnotationRemoved { id } => (Property::Annotation(*id), true),
        OperationKind::Invited { id, .. } => (Property::Invitation(*id), false),
        OperationKind::InvitationUsed { id } | OperationKind::InvitationRevoked { id } => {
            (Property::Invitation(*id), true)
        }
        _ => return None,
    })
}

/// Later operations that supersede earlier ones, while the log is read backwards.
#[derive(Debug, Default)]
struct Superseding {
    /// Participants who left more than [`KEPT`] ago.
    left: BTreeSet<ParticipantId>,
    /// Participants who reconnected more than [`KEPT`] ago.
    reconnected: BTreeSet<ParticipantId>,
    restored: BTreeSet<ParticipantId>,
    /// Properties with a later value.
    set: BTreeSet<Property>,
    /// The freeze in force.
    frozen_by: Option<OperationId>,
}

impl Superseding {
    fn fate(&mut self, operation: &Operation, now: ServerTime) -> Fate {
        let fate = self.fate_of_value(operation, now);
        let has_left = about(&operation.kind).is_some_and(|who| self.left.contains(&who));
        // A tool that was inactive during a freeze is no longer held, although it is active again.
        let ends_hold = !has_left
            && self.frozen_by.is_some_and(|freeze| operation.id > freeze)
            && matches!(
                operation.kind,
                OperationKind::Muted { .. }
                    | OperationKind::Disconnected { .. }
                    | OperationKind::Reconnected { .. }
                    | OperationKind::Demoted { .. }
                    | OperationKind::Restored { .. }
            );
        if ends_hold { Fate::Kept } else { fate }
    }

    /// Whether later operations contain the effect of an operation.
    fn fate_of_value(&mut self, operation: &Operation, now: ServerTime) -> Fate {
        let is_old = now - operation.at >= KEPT;
        if let Some((property, is_initial)) = sets(&operation.kind) {
            if !self.set.insert(property) {
                return Fate::Replaced;
            }
            // Clients drop an expired invitation on their own.
            let is_expired = matches!(&operation.kind, OperationKind::Invited { expires_at, .. } if now >= *expires_at);
            if is_old && (is_initial || is_expired) {
                return Fate::Dropped;
            }
        }
        let Some(who) = about(&operation.kind).filter(|_| is_old) else {
            return Fate::Kept;
        };
        if matches!(operation.kind, OperationKind::Left { .. }) {
            self.left.insert(who);
        }
        let is_superseded = match operation.kind {
            OperationKind::Reconnected { .. } => {
                self.reconnected.insert(who);
                true
            }
            OperationKind::Disconnected { .. } => self.reconnected.contains(&who),
            OperationKind::Restored { .. } => {
                self.restored.insert(who);
                true
            }
            OperationKind::Demoted { .. } => self.restored.contains(&who),
            _ => false,
        };
        if is_superseded || self.left.contains(&who) {
            Fate::Dropped
        } else {
            Fate::Kept
        }
    }
}

/// The participant whom an operation is about; `None` for operations about the tissue and the session.
fn about(kind: &OperationKind) -> Option<ParticipantId> {
    match kind {
        OperationKind::Joined { participant, .. }
        | OperationKind::Left { participant, .. }
        | OperationKind::Disconnected { participant }
        | OperationKind::Reconnected { participant }
        | OperationKind::ToolChanged { participant, .. }
        | OperationKind::Demoted { participant, .. }
        | OperationKind::Restored { participant }
        | OperationKind::Muted { participant, .. }
        | OperationKind::ForceLimit { participant, .. }
        | OperationKind::Emulated { participant, .. } => Some(*participant),
        OperationKind::Cut(_)
        | OperationKind::Started { .. }
        | OperationKind::Compensation { .. }
        | OperationKind::Frozen { .. }
        | OperationKind::Reset
        | OperationKind::Undone
        | OperationKind::Redone
        | OperationKind::Access { .. }
        | OperationKind::CompensationMode { .. }
        | OperationKind::Annotated(_)
        | OperationKind::AnnotationRemoved { .. }
        | OperationKind::CameraShown(_)
        | OperationKind::Invited { .. }
        | OperationKind::InvitationUsed { .. }
        | OperationKind::InvitationRevoked { .. } => None,
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::control::{ANNOTATION_MAX_BYTES, Annotation};
    use palpate_protocol::examples::annotation;
    use palpate_protocol::handshake::ROSTER_MAX;
    use palpate_protocol::operation::{
        BladePoint, CutStroke, HeldTool, LeaveReason, STROKE_MAX_POINTS,
    };
    use palpate_protocol::session::STREAM_BACKLOG_MAX_BYTES;
    use palpate_protocol::tool::ToolDescription;
    use palpate_protocol::{Pose, Role, TopologyHash};
    use proptest::prelude::*;

    use super::*;

    fn at(s: i64) -> ServerTime {
        ServerTime::from_micros(s * 1_000_000)
    }

    fn add(log: &mut Log, second: i64, kind: OperationKind) -> u64 {
        log.push(Arc::new(Operation {
            id: log.next(),
            at: at(second),
            author: ParticipantId(u16::MAX),
            topology_version_before: u32::MAX,
            topology_version_after: u32::MAX,
            hash_after: TopologyHash(u64::MAX),
            kind,
        }))
    }

    fn stroke(points: usize) -> OperationKind {
        let blade = BladePoint {
            tip_m: [0.123; 3],
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.03,
        };
        OperationKind::Cut(CutStroke {
            began: ServerTime::ZERO,
            joins: false,
            points: vec![blade; points],
            width_m: 0.001,
        })
    }

    fn joined(who: u16) -> OperationKind {
        OperationKind::Joined {
            participant: ParticipantId(who),
            name: "x".repeat(64),
            role: Role::Trainee,
            tool: Some(ToolDescription::scalpel(0.001, 0.02)),
        }
    }

    /// The bytes of the log on the wire.
    fn bytes(log: &Log) -> usize {
        let frame = |o: &Arc<Operation>| {
            encode_frame(&ServerMessage::Operation(o.as_ref().clone())).unwrap()
        };
        log.since(OperationId(0))
            .iter()
            .map(|o| frame(o).len())
            .sum()
    }

    #[test]
    fn full_log_of_longest_operations_fits_a_new_client() {
        for points in [2, STROKE_MAX_POINTS] {
            let mut log = Log::default();
            while log.takes_cut(0) {
                add(&mut log, 0, stroke(points));
            }
            assert!(log.len() > 900, "{} strokes", log.len());
            while log.takes_delay() {
                let change = OperationKind::Compensation {
                    delay_us: u32::MAX,
                    effective_at: at(i64::from(u32::MAX)),
                };
                add(&mut log, 0, change);
            }
            while log.takes_seat() {
                add(&mut log, 0, joined(u16::MAX));
            }
            // One burst of freezes with all tools, the rest annotations.
            let held = HeldTool {
                participant: ParticipantId(u16::MAX),
                pose: Pose::IDENTITY,
                buttons: 0,
            };
            let frozen = OperationKind::Frozen {
                is_frozen: true,
                held: vec![held; ROSTER_MAX],
            };
            for _ in 0..128 {
                add(&mut log, 0, frozen.clone());
            }
            let annotation = Annotation {
                text: "x".repeat(ANNOTATION_MAX_BYTES),
                ..annotation()
            };
            while log.takes_control() {
                add(&mut log, 0, OperationKind::Annotated(annotation.clone()));
            }
            while log.takes_return() {
                add(&mut log, 0, OperationKind::Undone);
            }
            assert!(log.len() <= 26_900, "{}", log.len());
            assert!(bytes(&log) + FRAME_MAX_BYTES < STREAM_BACKLOG_MAX_BYTES);
        }
    }

    #[test]
    fn newcomers_read_nothing_about_departed_participants() {
        let who = ParticipantId(7);
        let mut log = Log::default();
        add(&mut log, 0, joined(7));
        add(&mut log, 0, joined(8));
        add(
            &mut log,
            10,
            OperationKind::Disconnected { participant: who },
        );
        add(
            &mut log,
            11,
            OperationKind::Reconnected { participant: who },
        );
        add(&mut log, 20, stroke(2));
        add(
            &mut log,
            30,
            OperationKind::Disconnected { participant: who },
        );
        log.compact(at(90));
        assert_eq!(log.len(), 4, "the reconnect and its loss are dropped");
        assert_eq!(log.complete_from(), OperationId(4));
        let reason = LeaveReason::Silent;
        let left = OperationKind::Left {
            participant: who,
            reason,
        };
        add(&mut log, 91, left);
        log.compact(at(160));
        assert_eq!(
            log.len(),
            5,
            "a client may still resume without the last minute"
        );
        log.compact(at(162));
        let kept: Vec<u64> = log.since(OperationId(0)).iter().map(|o| o.id.0).collect();
        assert_eq!(kept, [1, 4], "the other participant and the cut");
        assert_eq!(log.next(), OperationId(7));
        assert_eq!(log.complete_from(), OperationId(7));
        assert_eq!(log.last_before(OperationId(4)).unwrap().id.0, 1);
        assert_eq!(log.last_before(OperationId(7)).unwrap().id.0, 4);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        /// One author cuts as much as it may, also under new numbers.
        #[test]
        fn other_authors_still_cut_whatever_one_author_does(
            cuts in prop::collection::vec((1_usize..STROKE_MAX_POINTS, any::<bool>()), 1..50),
            others in 0_u64..2_000_000,
        ) {
            let mut log = Log::default();
            let (mut departed, mut used) = (0, 0);
            for (points, rejoins) in cuts.into_iter().cycle().take(8_000) {
                if rejoins {
                    // A newcomer inherits the space of those who left.
                    departed = used;
                }
                if log.takes_cut(used) {
                    used += add(&mut log, 0, stroke(points));
                }
            }
            prop_assert!(departed <= used);
            prop_assert!(log.takes_cut(others), "{} used of the log", used);
        }

        #[test]
        fn churn_of_participants_keeps_the_log_short(
            steps in prop::collection::vec((0_u16..4, any::<bool>()), 1..100),
        ) {
            let mut log = Log::default();
            let mut who = 0;
            for (second, (joins, leaves)) in (0..4000).zip(steps.iter().cycle()) {
                for _ in 0..*joins {
                    who += 1;
                    add(&mut log, second, joined(who));
                    if *leaves {
                        let reason = LeaveReason::Left;
                        add(&mut log, second, OperationKind::Left { participant: ParticipantId(who), reason });
                    } else {
                        add(&mut log, second, OperationKind::Disconnected { participant: ParticipantId(who) });
                        add(&mut log, second, OperationKind::Left { participant: ParticipantId(who), reason: LeaveReason::Silent });
                    }
                }
                log.compact(at(second));
            }
            prop_assert!(log.len() <= 72 * 4 * 3);
            prop_assert!(log.about_participants == log.len());
        }
    }
}
