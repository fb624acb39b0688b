//! The session's log: operations that every site applies in the same order.

use serde::{Deserialize, Serialize};

use crate::handshake::Role;
use crate::tool::ToolDescription;
use crate::{OperationId, ParticipantId, ServerTime, TopologyHash};

/// The most blade points in one stroke. 512 points of 56 B stay below half of the largest frame. The
/// server refuses a longer stroke; the client cuts it in pieces.
pub const STROKE_MAX_POINTS: usize = 512;

/// One numbered entry of the log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Operation {
    /// Its position in the log.
    pub id: OperationId,
    /// The time of the operation: sites show it at `at` + D.
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
    /// Cuts the tissue along a stroke.
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
    /// A restarted client resumed the seat with another tool.
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
}

/// A stroke of the blade through the tissue, in the rest frame of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CutStroke {
    /// The poses of the blade in order, at most [`STROKE_MAX_POINTS`].
    #[serde(deserialize_with = "crate::bounded_list::at_most::<STROKE_MAX_POINTS, _, _>")]
    pub points: Vec<BladePoint>,
    /// Width of the blade in metres.
    pub width_m: f64,
}

/// The blade at one moment of a stroke.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BladePoint {
    /// The tip in metres.
    pub tip_m: [f64; 3],
    /// Unit vector from the tip outwards along the blade.
    pub axis: [f64; 3],
    /// The length of the blade inside the tissue, from the tip backwards, metres.
    pub depth_m: f64,
}

impl BladePoint {
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

/// The compensation in force when a client joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CompensationSettings {
    /// The rule for the delay.
    pub mode: CompensationMode,
    /// The delay that the session began with, microseconds; later changes are operations.
    pub initial_delay_us: u32,
}
