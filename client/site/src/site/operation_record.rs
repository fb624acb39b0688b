//! Records of applied operations, for the recording of a run.

use palpate_protocol::operation::{CutStroke, OperationKind};
use serde::{Deserialize, Serialize};

/// An applied operation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OperationRecord {
    /// Index in the log.
    pub id: u64,
    /// Kind of operation, one word.
    pub kind: String,
    /// Time of the operation, server clock.
    pub at_us: i64,
    /// Time of application here, monotonic.
    pub applied_us: i64,
    /// By how much the displayed time was past it, negative for an operation that does not wait; `None` for the log before
    /// the join.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late_us: Option<i64>,
    /// Topology version after it.
    pub version: u32,
    /// Topology hash after it, 16 hexadecimal digits.
    pub hash: String,
    /// Beginning of all scripts, server clock, where the operation sets it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub script_at_us: Option<i64>,
    /// The stroke of a cut or its part, in the rest frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stroke: Option<CutStroke>,
}

/// The word of an operation in recordings.
pub(super) const fn word(kind: &OperationKind) -> &'static str {
    match kind {
        OperationKind::Cut(_) => "cut",
        OperationKind::Joined { .. } => "joined",
        OperationKind::Left { .. } => "left",
        OperationKind::Disconnected { .. } => "away",
        OperationKind::Reconnected { .. } => "back",
        OperationKind::ToolChanged { .. } => "tool-changed",
        OperationKind::Started { .. } => "started",
        OperationKind::Compensation { .. } => "compensation",
        OperationKind::Demoted { .. } => "demoted",
        OperationKind::Restored { .. } => "restored",
        OperationKind::Muted { .. } => "muted",
        OperationKind::Frozen { .. } => "frozen",
        OperationKind::Reset => "reset",
        OperationKind::Undone => "undone",
        OperationKind::Redone => "redone",
        OperationKind::ForceLimit { .. } => "force-limit",
        OperationKind::Access { .. } => "access",
        OperationKind::CompensationMode { .. } => "compensation-mode",
        OperationKind::Annotated(_) => "annotated",
        OperationKind::AnnotationRemoved { .. } => "annotation-removed",
        OperationKind::CameraShown(_) => "camera-shown",
        OperationKind::Invited { .. } => "invited",
        OperationKind::InvitationUsed { .. } => "invitation-used",
        OperationKind::InvitationRevoked { .. } => "invitation-revoked",
        OperationKind::Emulated { .. } => "emulated",
    }
}
