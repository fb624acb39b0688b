//! Handshake: a preamble that every version can read, then [`Hello`], then [`Welcome`] or [`Refused`].
//!
//! The preamble's layout never changes, whatever the version:
//!
//! ```text
//! client -> server   "PALP"  version u16 LE   0 u16
//! server -> client   "PALP"  version u16 LE   status u16   (status 1: length u16 LE, UTF-8 sentence)
//! ```

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::operation::{CompensationSettings, Operation};
use crate::tool::ToolDescription;
use crate::{
    Epoch, Grant, ModelHash, OperationId, ParticipantId, ProtocolError, ResumeToken, ServerTime,
    Span, TopologyHash,
};

/// The protocol version of this crate. Every change of a message, or of the nodes that a cut gives, increments it.
pub const PROTOCOL_VERSION: u16 = 16;

/// The first bytes of every palpate stream.
pub const MAGIC: [u8; 4] = *b"PALP";

/// Size of the fixed part of a preamble in bytes.
pub const PREAMBLE_BYTES: usize = 8;

/// The longest sentence after a server's preamble in bytes. The sender truncates a longer one; the
/// receiver rejects it.
pub const PREAMBLE_SENTENCE_MAX_BYTES: usize = 512;

/// The most participants of a session; a roster longer than this is a protocol error.
pub const ROSTER_MAX: usize = 64;

/// The longest snapshot in bytes. It fits the backlog of a peer together with the longest log.
pub const SNAPSHOT_MAX_BYTES: u32 = 16 * 1024 * 1024;

/// The longest piece of a snapshot in bytes.
pub const SNAPSHOT_PIECE_BYTES: usize = 32 * 1024;

/// How long the server keeps the seat of a participant whose connection was lost.
pub const SEAT_RETENTION: Span = Span::from_millis(60_000);

/// The fixed bytes that come before everything else.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Preamble {
    /// The sender's version.
    pub version: u16,
    /// From the server: 0 accepts, 1 refuses and a sentence follows. From a client: 0.
    pub status: u16,
}

impl Preamble {
    /// The accepting preamble of this version.
    pub const OURS: Self = Self {
        version: PROTOCOL_VERSION,
        status: 0,
    };

    /// The bytes on the wire.
    pub fn to_bytes(self) -> [u8; PREAMBLE_BYTES] {
        let mut out = [0; PREAMBLE_BYTES];
        out[..4].copy_from_slice(&MAGIC);
        out[4..6].copy_from_slice(&self.version.to_le_bytes());
        out[6..].copy_from_slice(&self.status.to_le_bytes());
        out
    }

    /// Reads a preamble and checks only the magic; the caller checks the version.
    pub fn from_bytes(bytes: [u8; PREAMBLE_BYTES]) -> Result<Self, ProtocolError> {
        let [a, b, c, d, v0, v1, s0, s1] = bytes;
        let found = [a, b, c, d];
        if found != MAGIC {
            return Err(ProtocolError::NotPalpate { found });
        }
        Ok(Self {
            version: u16::from_le_bytes([v0, v1]),
            status: u16::from_le_bytes([s0, s1]),
        })
    }
}

/// The rights of a participant in a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Role {
    /// Has a tool, may cut, and controls the session.
    Instructor,
    /// Has a tool and may cut.
    Trainee,
    /// Sees the session and has no tool.
    Spectator,
    /// A program that records the session.
    Recorder,
}

impl Role {
    /// All roles, in display order.
    pub const ALL: [Self; 4] = [
        Self::Instructor,
        Self::Trainee,
        Self::Spectator,
        Self::Recorder,
    ];

    /// The name of this role in links and on screens.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Instructor => "instructor",
            Self::Trainee => "trainee",
            Self::Spectator => "spectator",
            Self::Recorder => "recorder",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// The error for a word that names no role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown role \"{0}\"; the roles are instructor, trainee, spectator and recorder")]
pub struct UnknownRole(pub String);

impl FromStr for Role {
    type Err = UnknownRole;

    fn from_str(s: &str) -> Result<Self, UnknownRole> {
        Self::ALL
            .into_iter()
            .find(|r| r.word() == s)
            .ok_or_else(|| UnknownRole(s.to_owned()))
    }
}

/// The data about the tissue that the server sends to a participant.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize,
)]
pub enum Subscription {
    /// Tools, operations and corrections, from which it computes the tissue itself.
    #[default]
    Full,
    /// Node displacements in view; the client computes nothing. For roles without a tool.
    Thin,
}

impl Subscription {
    /// Both, in display order.
    pub const ALL: [Self; 2] = [Self::Full, Self::Thin];

    /// Its name on command lines and screens.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Thin => "thin",
        }
    }
}

impl fmt::Display for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// The error for a word that names no subscription.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "unknown subscription \"{0}\"; choose full (this machine computes the tissue) or thin (the server \
     sends the surface, for roles without a tool)"
)]
pub struct UnknownSubscription(pub String);

impl FromStr for Subscription {
    type Err = UnknownSubscription;

    fn from_str(s: &str) -> Result<Self, UnknownSubscription> {
        Self::ALL
            .into_iter()
            .find(|x| x.word() == s)
            .ok_or_else(|| UnknownSubscription(s.to_owned()))
    }
}

/// A client's first message: name, role and grant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// The participant's name as shown to the other participants; the server [normalises](crate::name::normalise) it.
    pub name: String,
    /// The requested role; the grant must allow it.
    pub role: Role,
    /// The secret from the join link.
    pub grant: Grant,
    /// The tool the participant will hold, for roles that have one.
    pub tool: Option<ToolDescription>,
    /// The requested subscription.
    pub subscription: Subscription,
    /// Resumes a lost seat.
    pub resume: Option<Resume>,
}

/// The seat of a reconnecting client and the part of the log that the client holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resume {
    /// The participant's number.
    pub participant: ParticipantId,
    /// The token from its [`Welcome`].
    pub token: ResumeToken,
    /// The first operation that it does not have.
    pub next_operation: OperationId,
    /// How often the topology has changed after the operations that it has.
    pub topology_version: u32,
    /// The topology hash after the operations that it has. A server whose log gives another hash at this
    /// position sends the whole log.
    pub topology_hash: TopologyHash,
}

impl Resume {
    /// The seat from a welcome. The log position is empty or taken from `before`.
    pub fn after_welcome(welcome: &Welcome, before: Option<Self>) -> Self {
        let had = before.filter(|b| b.next_operation == welcome.first_operation);
        Self {
            participant: welcome.participant,
            token: welcome.resume_token,
            next_operation: welcome.first_operation,
            topology_version: had.map_or(0, |b| b.topology_version),
            topology_hash: had.map_or(TopologyHash(0), |b| b.topology_hash),
        }
    }

    /// Notes the next operation of the log.
    pub fn note(&mut self, operation: &Operation) {
        self.next_operation = operation.id.next();
        self.topology_version = operation.topology_version_after;
        self.topology_hash = operation.hash_after;
    }
}

/// The model that a session runs on; fetched separately when the client does not hold it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelInfo {
    /// Hash of the file's bytes.
    pub hash: ModelHash,
    /// Size of the file in bytes.
    pub bytes: u64,
}

/// A snapshot of the cuts: the topology and the strokes to undo and redo. It replaces operations of the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SnapshotInfo {
    /// Its size, at least 1 and at most [`SNAPSHOT_MAX_BYTES`].
    pub bytes: u32,
    /// The topology version that it restores. The log leaves out changes of the topology up to it.
    pub topology_version: u32,
}

/// One line of the roster.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RosterEntry {
    /// The participant's number.
    pub participant: ParticipantId,
    /// The participant's name.
    pub name: String,
    /// The participant's role.
    pub role: Role,
    /// The participant's tool, where the role has one.
    pub tool: Option<ToolDescription>,
}

/// The server's answer to a [`Hello`] it accepts. The snapshot follows, if there is one, and then the log: first the
/// operations from `first_operation` up to `operations_so_far`, then each new one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// The number of the new participant.
    pub participant: ParticipantId,
    /// Carried by every datagram from now on.
    pub epoch: Epoch,
    /// The role given.
    pub role: Role,
    /// The server's clock when the message was written: a first guess until the clock estimate locks.
    pub server_time: ServerTime,
    /// The model to hold.
    pub model: ModelInfo,
    /// All participants including the new one, at most [`ROSTER_MAX`].
    #[serde(deserialize_with = "crate::bounded_list::at_most::<ROSTER_MAX, _, _>")]
    pub roster: Vec<RosterEntry>,
    /// How often the topology has changed after `operations_so_far` operations.
    pub topology_version: u32,
    /// The topology hash after `operations_so_far` operations.
    pub topology_hash: TopologyHash,
    /// The first operation that follows: 0, or the position of a resumed client.
    pub first_operation: OperationId,
    /// The snapshot that comes before the log; `None` for a resumed client and before the first one.
    pub snapshot: Option<SnapshotInfo>,
    /// The number after that of the last operation that follows on the stream at once; `first_operation` if none does.
    /// The stream leaves out operations that no longer matter.
    pub operations_so_far: u64,
    /// The artificial time compensation in force. Changes come as operations.
    pub compensation: CompensationSettings,
    /// The server's steps per second.
    pub tick_hz: u32,
    /// The start time of the scripts, if they have started.
    pub session_started_at: Option<ServerTime>,
    /// The token that resumes this seat after a lost connection, within [`SEAT_RETENTION`].
    pub resume_token: ResumeToken,
}

/// The server's answer to a [`Hello`] it does not accept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// For programs.
    pub reason: RefusalReason,
    /// For people: the cause and the remedy.
    pub sentence: String,
}

impl Refused {
    /// A refusal with the sentence that goes with its reason.
    pub fn because(reason: RefusalReason) -> Self {
        let sentence = reason.to_string();
        Self { reason, sentence }
    }
}

/// Why the server refuses a client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum RefusalReason {
    /// Another version of the protocol.
    #[error(
        "the server speaks protocol version {server_speaks}, this client speaks version {PROTOCOL_VERSION}; use the release that the server runs"
    )]
    Version {
        /// The server's version.
        server_speaks: u16,
    },
    /// No seat for this role is left.
    #[error(
        "the session is full: all {seats} seats for the role {role} are taken; come back when a participant has left, or ask the host to offer more (--seats, {ROSTER_MAX} at most; --spectators for spectators and recorders)"
    )]
    Full {
        /// The requested role.
        role: Role,
        /// The number of seats that this role can take, together with the other roles that share them.
        seats: u16,
    },
    /// The grant is unknown or allows another role.
    #[error(
        "the grant in the join link does not allow the role {role}; ask the host for a new link"
    )]
    BadGrant {
        /// The requested role.
        role: Role,
    },
    /// Another participant has this name, or one that looks like it.
    #[error("a participant named \"{name}\" is already in the session; choose another name")]
    NameTaken {
        /// The name of that participant.
        name: String,
    },
    /// The name can not be shown.
    #[error("{reason}")]
    BadName {
        /// The cause and the remedy.
        reason: String,
    },
    /// The role needs a tool and the client offered no valid one.
    #[error(
        "the role {role} needs a tool with a radius between 0.1 mm and 100 mm, and with the length and width of its kind (at most 200 mm)"
    )]
    BadTool {
        /// The requested role.
        role: Role,
    },
    /// A thin subscription for a role that needs the tissue.
    #[error(
        "a thin subscription has no tissue of its own, and the role {role} needs it to feel or to record; join with \
         the subscription full, or as a spectator"
    )]
    ThinTool {
        /// The requested role.
        role: Role,
    },
    /// The seat is gone or the token belongs to another seat; the client does not learn which.
    #[error(
        "the seat to resume has expired or belongs to another participant; join again as a new participant"
    )]
    NoSuchSeat,
    /// The session ends or the server stops.
    #[error("the server is closing the session; try again later")]
    Closing,
    /// Too many joins or resumptions in a short time.
    #[error("the session receives too many joins at this time; try again in a few seconds")]
    Busy,
    /// The instructor has locked the session.
    #[error("the instructor has locked the session; ask the instructor to open it")]
    Locked,
    /// The instructor has banned a participant with this name, or one that looks like it.
    #[error("the instructor has removed \"{name}\" from this session for its whole duration")]
    Banned {
        /// The name of that participant.
        name: String,
    },
    /// The lifetime of the invitation is over.
    #[error("the invitation has expired; ask the instructor for a new one")]
    InvitationExpired,
    /// The instructor has revoked the invitation.
    #[error("the instructor has revoked the invitation; ask the instructor for a new one")]
    InvitationRevoked,
    /// The invitation was for a single use.
    #[error(
        "the invitation was for a single use and has been used; ask the instructor for a new one"
    )]
    InvitationUsed,
    /// The invitation is for another name.
    #[error(
        "the invitation is for the name \"{name}\"; join under that name, or ask the instructor for another invitation"
    )]
    InvitationName {
        /// The only name that may use it.
        name: String,
    },
}

impl RefusalReason {
    /// Whether the same join may be accepted a little later.
    pub const fn is_temporary(&self) -> bool {
        matches!(self, Self::Full { .. } | Self::Busy)
    }
}
