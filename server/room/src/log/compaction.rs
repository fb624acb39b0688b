//! Decides which operations of the log no longer matter.

use std::collections::BTreeSet;
use std::sync::Arc;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::{OperationId, ParticipantId, ServerTime};

use super::{COMPACTION_PERIOD, COVERED_MAX_BYTES, KEPT, Log, space_of};

impl Log {
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
        let mut covered_bytes = 0;
        let mut fate = |o: &Arc<Operation>| {
            if !self.covers(o) {
                return superseding.fate(o, now);
            }
            covered_bytes += space_of(&o.kind);
            if now - o.at >= KEPT || covered_bytes > COVERED_MAX_BYTES {
                Fate::Dropped
            } else {
                Fate::Kept
            }
        };
        let mut fates: Vec<Fate> = self.operations.iter().rev().map(&mut fate).collect();
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
            if o.kind.changes_topology() {
                let state = (o.topology_version_after, o.hash_after);
                // Times do not ascend: a later change may have been dropped before.
                if self.dropped.is_none_or(|(after, _)| after <= o.id) {
                    self.dropped = Some((o.id.next(), state));
                }
            } else if about(&o.kind).is_some() {
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
pub(super) fn about(kind: &OperationKind) -> Option<ParticipantId> {
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
