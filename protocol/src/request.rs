//! A client's requests to the server, and all messages on the operations stream.

use serde::{Deserialize, Serialize};

use crate::control::Control;
use crate::handshake::{Hello, Refused, SNAPSHOT_PIECE_BYTES, Welcome};
use crate::operation::{BladePoint, Operation, STROKE_MAX_POINTS};
use crate::tool::ToolDescription;
use crate::{Grant, RequestId, ServerTime, TopologyHash};

/// The messages of a client on the operations stream after the preamble.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum ClientMessage {
    /// The first message, once.
    Hello(Hello),
    /// All later messages.
    Request(Request),
}

/// The messages of the server on the operations stream after the preamble.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum ServerMessage {
    /// The answer to a hello that is accepted.
    Welcome(Box<Welcome>),
    /// The answer to a hello that is not; nothing follows.
    Refused(Refused),
    /// The next operation of the log.
    Operation(Operation),
    /// The refusal of a request.
    RequestRefused(RequestRefused),
    /// The server ends this session, with a sentence; nothing follows.
    Goodbye {
        /// The reason, for people.
        sentence: String,
    },
    /// The answer to [`Control::Invite`], for the requester alone.
    Invitation(Invitation),
    /// The next piece of the snapshot that the welcome announces.
    Snapshot(
        #[serde(deserialize_with = "crate::bounded_list::at_most::<SNAPSHOT_PIECE_BYTES, _, _>")]
        Vec<u8>,
    ),
}

/// A new invitation with its secret. The server sends it after the operation
/// [`Invited`](crate::operation::OperationKind::Invited) with the same number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Invitation {
    /// Its number.
    pub id: u32,
    /// The secret that admits its holder.
    pub grant: Grant,
}

/// One request of a client.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// Counts up from 1 for a seat, over all its connections. A number that the seat used over an
    /// earlier connection is a repetition, and the server does not apply it twice.
    pub id: RequestId,
    /// The requested change.
    pub kind: RequestKind,
}

/// The changes that a client can request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum RequestKind {
    /// Cut along a stroke.
    Cut(CutRequest),
    /// Leave the session.
    Leave,
    /// The topology that this client has, for the server to compare.
    TopologyReport {
        /// How many topology changes it applied.
        version: u32,
        /// The hash it has.
        hash: TopologyHash,
    },
    /// Hold another tool.
    SetTool(ToolDescription),
    /// Control the session; for instructors.
    Control(Control),
}

impl RequestKind {
    /// Whether every number is in range; a request that is not is a protocol violation.
    pub fn is_valid(&self) -> bool {
        match self {
            Self::Cut(cut) => cut.is_valid(),
            Self::SetTool(tool) => tool.is_valid(),
            Self::Control(control) => control.is_valid(),
            Self::Leave | Self::TopologyReport { .. } => true,
        }
    }
}

/// A stroke, or the part of it since the part before, as the participant's hand made it: in the world frame, on the
/// deformed tissue. A client sends parts while the blade moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CutRequest {
    /// When the stroke began, by the time of its first point. Parts with an equal beginning are one stroke.
    pub began: ServerTime,
    /// The blade over time, oldest first, at most [`STROKE_MAX_POINTS`]. A later part begins with the last point of the part
    /// before.
    #[serde(deserialize_with = "crate::bounded_list::at_most::<STROKE_MAX_POINTS, _, _>")]
    pub points: Vec<TimedBladePoint>,
    /// Width of the blade in metres.
    pub width_m: f64,
    /// Whether the stroke ends with this part.
    pub is_last: bool,
}

impl CutRequest {
    /// A whole stroke.
    pub fn whole(points: Vec<TimedBladePoint>, width_m: f64) -> Self {
        Self {
            began: points.first().map_or(ServerTime::ZERO, |p| p.time),
            points,
            width_m,
            is_last: true,
        }
    }

    /// Whether there are 1 to [`STROKE_MAX_POINTS`] valid points in the order of time, none before the beginning, and the
    /// width is at most 0.1 m.
    pub fn is_valid(&self) -> bool {
        (1..=STROKE_MAX_POINTS).contains(&self.points.len())
            && self.points.iter().all(|p| p.blade.is_valid())
            && self.points.is_sorted_by_key(|p| p.time)
            && self.points.iter().all(|p| self.began <= p.time)
            && (0.0..=0.1).contains(&self.width_m)
    }
}

/// The blade in the world frame, at a moment of server time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TimedBladePoint {
    /// When.
    pub time: ServerTime,
    /// Where, world frame.
    pub blade: BladePoint,
}

/// One site's measurement of the age of received motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DelayReport {
    /// Mean age on arrival μ, microseconds.
    pub mean_us: u32,
    /// Mean deviation ν, microseconds.
    pub deviation_us: u32,
    /// The delay D* that this site needs, microseconds.
    pub wanted_us: u32,
}

/// The answer to a refused request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestRefused {
    /// The number of the request.
    pub id: RequestId,
    /// The reason.
    pub reason: RequestRefusal,
}

/// The reason for refusing a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum RequestRefusal {
    /// The role does not allow it.
    #[error("your role does not allow this")]
    NotAllowed,
    /// The stroke touches no tissue.
    #[error("the stroke does not pass through the tissue")]
    NothingCut,
    /// The tissue refused the stroke.
    #[error("the stroke can not be cut: {0}")]
    CanNotCut(String),
    /// The client exceeds the request rate, or its cuts exceed the participant's share of the server's time.
    #[error("too many requests or cuts; wait a moment")]
    TooMany,
    /// The topology differs from the server's: the client must rejoin.
    #[error("your copy of the tissue differs from the server's; rejoin the session")]
    TopologyDiffers,
    /// The requester is demoted, because of its network.
    #[error(
        "your tool is inactive, because your network needs more delay than the session allows; it becomes active again when the network has recovered"
    )]
    Demoted,
    /// The cuts are so many that new participants could not receive any more of them.
    #[error(
        "the tissue has too many cuts for new participants to receive; ask the instructor to reset the tissue"
    )]
    LogFull,
    /// The stroke lies where the tool can not have been.
    #[error(
        "the stroke does not follow your tool: {0}; the server must receive the tool's motion during the stroke, so check the network and repeat the stroke"
    )]
    NotAtTool(String),
    /// No cut is in effect.
    #[error("there is no cut to undo")]
    NothingToUndo,
    /// No cut was taken back since the last cut.
    #[error("there is no cut to redo")]
    NothingToRedo,
    /// The session is frozen.
    #[error("the instructor has frozen the session; wait until it continues")]
    Frozen,
    /// The requester's tool is muted.
    #[error("the instructor has muted your tool; wait until it is active again")]
    Muted,
    /// No participant has the number.
    #[error("the participant has left the session")]
    UnknownParticipant,
    /// A value is not possible in this session.
    #[error("{0}")]
    OutOfRange(String),
}
