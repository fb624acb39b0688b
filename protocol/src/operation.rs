//! The session's log: operations that every site applies in the same order.

use serde::{Deserialize, Serialize};

use crate::compensation::CAP_DEFAULT;
use crate::control::{Annotation, CameraView, is_force_limit, is_mode, is_name};
use crate::handshake::{ROSTER_MAX, Role};
use crate::tool::ToolDescription;
use crate::{Emulation, OperationId, ParticipantId, Pose, ServerTime, Span, TopologyHash};

/// The most blade points in one stroke. 512 points of 28 B stay below a quarter of the largest frame. The
/// server refuses a longer stroke; the client cuts it in pieces.
pub const STROKE_MAX_POINTS: usize = 512;

/// One numbered entry of the log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Operation {
    /// Its position in the log.
    pub id: OperationId,
    /// The time of the operation; that of the blade for a cut, so that times do not ascend. Sites apply an operation that
    /// [waits](OperationKind::waits) at `at` + D, and none before one with a smaller number.
    pub at: ServerTime,
    /// The participant that requested it.
    pub author: ParticipantId,
    /// The topology version that it applies to.
    pub topology_version_before: u32,
    /// The topology version after it; unchanged unless the operation changes the topology.
    pub topology_version_after: u32,
    /// The topology hash after it, for comparison with the replica's hash.
    pub hash_after: TopologyHash,
    /// The change.
    pub kind: OperationKind,
}

/// The change that an operation makes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum OperationKind {
    /// Cuts the tissue along a stroke or a part of one.
    Cut(CutStroke),
    /// A participant joined.
    Joined {
        /// The participant's number.
        participant: ParticipantId,
        /// The participant's name.
        name: String,
        /// The participant's role.
        role: Role,
        /// The participant's tool, where the role has one.
        tool: Option<ToolDescription>,
    },
    /// A participant left, together with the tool.
    Left {
        /// The participant's number.
        participant: ParticipantId,
        /// The cause.
        reason: LeaveReason,
    },
    /// A participant's connection was lost: the tool no longer presses, the seat is kept.
    Disconnected {
        /// The participant's number.
        participant: ParticipantId,
    },
    /// A participant whose connection was lost has resumed the seat.
    Reconnected {
        /// The participant's number.
        participant: ParticipantId,
    },
    /// A participant holds another tool, on request or because a restarted client resumed the seat with it.
    ToolChanged {
        /// The participant's number.
        participant: ParticipantId,
        /// The new tool.
        tool: ToolDescription,
    },
    /// Scripts and experiments begin at this moment.
    Started {
        /// The moment that is zero in every script.
        at: ServerTime,
    },
    /// The artificial delay changes.
    Compensation {
        /// The delay to reach, microseconds.
        delay_us: u32,
        /// When D starts to approach it, within the slew limits of
        /// [`DelaySchedule`](crate::compensation::DelaySchedule).
        effective_at: ServerTime,
    },
    /// A participant was demoted, because the network needs more delay than the session allows: the tool
    /// no longer presses, the seat is kept, and D no longer covers this participant.
    Demoted {
        /// The participant's number.
        participant: ParticipantId,
        /// The participant's delay estimate, microseconds.
        wanted_us: u32,
        /// The cap of D, microseconds.
        cap_us: u32,
    },
    /// The network of a demoted participant has recovered: the tool presses again.
    Restored {
        /// The participant's number.
        participant: ParticipantId,
    },
    /// The instructor made a tool inactive, or active again.
    Muted {
        /// The participant's number.
        participant: ParticipantId,
        /// Whether the tool is inactive.
        is_muted: bool,
    },
    /// All tools hold a pose from this operation on, or move again.
    Frozen {
        /// Whether the session is frozen.
        is_frozen: bool,
        /// The held tools; all other tools are inactive meanwhile. A participant who joins later has received no motion
        /// of them.
        #[serde(deserialize_with = "crate::bounded_list::at_most::<ROSTER_MAX, _, _>")]
        held: Vec<HeldTool>,
    },
    /// The tissue is uncut again. Nothing before it can be undone or redone.
    Reset,
    /// The last stroke in effect is taken back.
    Undone,
    /// The last stroke that was taken back is in effect again.
    Redone,
    /// The force limit of a participant's device changes.
    ForceLimit {
        /// The participant's number.
        participant: ParticipantId,
        /// The limit in N; `None` for that of the device alone.
        newtons: Option<f64>,
    },
    /// The conditions for joining change.
    Access {
        /// Whether only lost seats are given out.
        is_locked: bool,
        /// Seats in total.
        seats: u16,
        /// Seats that spectators and recorders may take together.
        spectators: u16,
    },
    /// The rule for the playout delay changes.
    CompensationMode {
        /// The rule.
        mode: CompensationMode,
    },
    /// An annotation is placed, or replaces the one with its number.
    Annotated(Annotation),
    /// An annotation is removed.
    AnnotationRemoved {
        /// Its number.
        id: u32,
    },
    /// One view direction is shown to all participants.
    CameraShown(CameraView),
    /// An instructor created an invitation. The log is for all participants, so its grant is not in it.
    Invited {
        /// Its number.
        id: u32,
        /// The role that it allows.
        role: Role,
        /// The only name that may use it; `None` for any name.
        name: Option<String>,
        /// The time from which on it is refused.
        expires_at: ServerTime,
        /// Whether the first join uses it up.
        is_single_use: bool,
    },
    /// A participant joined with an invitation for a single use, which is refused from now on.
    InvitationUsed {
        /// Its number.
        id: u32,
    },
    /// An instructor revoked an invitation, which is refused from now on.
    InvitationRevoked {
        /// Its number.
        id: u32,
    },
    /// The instructor emulates a network between the server and a participant.
    Emulated {
        /// The participant's number.
        participant: ParticipantId,
        /// Delay and loss; [`Emulation::NONE`] ends it.
        emulation: Emulation,
    },
}

impl OperationKind {
    /// Whether it changes the topology.
    pub const fn changes_topology(&self) -> bool {
        matches!(
            self,
            Self::Cut(_) | Self::Reset | Self::Undone | Self::Redone
        )
    }

    /// Whether it waits until sites show its time, because it changes the topology or displayed tools. All others take effect
    /// once the operations before them have.
    pub const fn waits(&self) -> bool {
        self.changes_topology()
            || matches!(
                self,
                Self::Left { .. }
                    | Self::Disconnected { .. }
                    | Self::Reconnected { .. }
                    | Self::ToolChanged { .. }
                    | Self::Demoted { .. }
                    | Self::Restored { .. }
                    | Self::Muted { .. }
                    | Self::Frozen { .. }
            )
    }

    /// Whether every number is in range and every text is visible.
    pub fn is_valid(&self) -> bool {
        match self {
            Self::Cut(stroke) => stroke.is_valid(),
            Self::ToolChanged { tool, .. } => tool.is_valid(),
            Self::ForceLimit { newtons, .. } => newtons.is_none_or(is_force_limit),
            Self::CompensationMode { mode } => is_mode(*mode),
            Self::Annotated(annotation) => annotation.is_valid(),
            Self::CameraShown(view) => view.is_valid(),
            Self::Frozen { held, .. } => held.iter().all(|h| h.pose.is_valid()),
            Self::Invited { name, .. } => name.as_deref().is_none_or(is_name),
            Self::Emulated { emulation, .. } => emulation.is_valid(),
            _ => true,
        }
    }
}

/// A tool that holds its pose while the session is frozen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldTool {
    /// The participant.
    pub participant: ParticipantId,
    /// The pose, that of the newest sample that the server had.
    pub pose: Pose,
    /// Its buttons, as in a sample.
    pub buttons: u8,
}

/// A stroke of the blade through the tissue, or the part of it since the part before, in the rest frame of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CutStroke {
    /// When the author began the stroke. Parts with equal author and beginning are one stroke.
    pub began: ServerTime,
    /// Whether the path continues at the last point of the part before it.
    pub joins: bool,
    /// The poses of the blade in order, at most [`STROKE_MAX_POINTS`].
    #[serde(deserialize_with = "crate::bounded_list::at_most::<STROKE_MAX_POINTS, _, _>")]
    pub points: Vec<BladePoint>,
    /// Width of the blade in metres.
    pub width_m: f64,
}

/// The blade at one moment of a stroke. In single precision on the wire: 0.1 µm at 1 m.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "SinglePrecision", into = "SinglePrecision")]
pub struct BladePoint {
    /// The tip in metres.
    pub tip_m: [f64; 3],
    /// Unit vector from the tip outwards along the blade.
    pub axis: [f64; 3],
    /// The length of the blade inside the tissue, from the tip backwards, metres.
    pub depth_m: f64,
}

/// A blade point on the wire.
#[derive(Serialize, Deserialize)]
struct SinglePrecision {
    tip_m: [f32; 3],
    axis: [f32; 3],
    depth_m: f32,
}

impl From<BladePoint> for SinglePrecision {
    fn from(p: BladePoint) -> Self {
        Self {
            tip_m: p.tip_m.map(|x| x as f32),
            axis: p.axis.map(|x| x as f32),
            depth_m: p.depth_m as f32,
        }
    }
}

impl From<SinglePrecision> for BladePoint {
    fn from(p: SinglePrecision) -> Self {
        Self {
            tip_m: p.tip_m.map(f64::from),
            axis: p.axis.map(f64::from),
            depth_m: f64::from(p.depth_m),
        }
    }
}

impl BladePoint {
    /// The point as a receiver reads it. The server cuts along such points, so that its tissue equals that of the replicas.
    #[must_use]
    pub fn rounded(self) -> Self {
        SinglePrecision::from(self).into()
    }

    /// Whether all numbers are finite, the axis is a unit vector and the depth is not negative.
    pub fn is_valid(&self) -> bool {
        let norm = self.axis.iter().map(|a| a * a).sum::<f64>();
        self.tip_m
            .iter()
            .all(|x| x.is_finite() && x.abs() <= crate::datagram::POSITION_MAX_M)
            && (norm - 1.0).abs() < 1e-3
            && self.depth_m.is_finite()
            && (0.0..=1.0).contains(&self.depth_m)
    }
}

impl CutStroke {
    /// Number of the stroke of an author, equal for all its parts and no other stroke of a session.
    pub fn number(&self, author: ParticipantId) -> u64 {
        let began = (self.began - ServerTime::ZERO).as_micros() as u64;
        u64::from(author.0) << 48 | (began & ((1 << 48) - 1))
    }

    /// The author of a stroke with this number.
    pub fn author_of(number: u64) -> ParticipantId {
        ParticipantId((number >> 48) as u16)
    }

    /// Whether the stroke has 1 to [`STROKE_MAX_POINTS`] valid points and a width of at most 0.1 m.
    pub fn is_valid(&self) -> bool {
        (1..=STROKE_MAX_POINTS).contains(&self.points.len())
            && self.points.iter().all(BladePoint::is_valid)
            && self.width_m.is_finite()
            && (0.0..=0.1).contains(&self.width_m)
    }
}

/// The reason why a participant left.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LeaveReason {
    /// The participant left.
    Left,
    /// The participant was silent for longer than the limit.
    Silent,
    /// The participant violated the protocol.
    Violation,
    /// The participant's connection could not take the operations fast enough.
    TooSlow,
    /// The instructor removed the participant.
    Removed,
}

/// The rule for the session's artificial delay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum CompensationMode {
    /// Every event is shown on arrival.
    None,
    /// One delay for the whole session.
    Fixed,
    /// The largest delay estimate of all participants, adapted over time.
    Adaptive {
        /// The cap of D, microseconds. A participant with a larger estimate is notified.
        cap_us: u32,
    },
}

impl CompensationMode {
    /// The largest D.
    pub fn cap(self) -> Span {
        match self {
            Self::Adaptive { cap_us } => Span::from_micros(i64::from(cap_us)),
            Self::None | Self::Fixed => CAP_DEFAULT,
        }
    }
}

/// The compensation in force when a client joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CompensationSettings {
    /// The rule for the delay.
    pub mode: CompensationMode,
    /// The delay that the session began with, microseconds; later changes are operations.
    pub initial_delay_us: u32,
}
