//! Records of applied operations, for the recording of a run.

use palpate_protocol::operation::CutStroke;
use serde::{Deserialize, Serialize};

/// An applied operation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OperationRecord {
    /// Index in the log.
    pub id: u64,
    /// Kind of operation, one word.
    pub kind: String,
    /// Due time, server clock.
    pub at_us: i64,
    /// Time of application here, monotonic.
    pub applied_us: i64,
    /// Topology version after it.
    pub version: u32,
    /// Topology hash after it, 16 hexadecimal digits.
    pub hash: String,
    /// The stroke of a cut, in the rest frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stroke: Option<CutStroke>,
}
