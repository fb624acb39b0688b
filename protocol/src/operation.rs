//! What everybody applies in the same order: the session's log.

use serde::{Deserialize, Serialize};

use crate::handshake::Role;
use crate::tool::ToolDescription;
use crate::{OperationId, ParticipantId, ServerTime, Span, TopologyHash};

/// The most blade points in one stroke. 512 points of 56 B stay below half of the largest frame;
/// a longer stroke is refused, and the client cuts it in pieces.
pub const STROKE_MAX_POINTS: usize = 512;

/// One numbered entry of the log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Operation {
    /// Its place in the log.
    pub id: OperationId,
    /// When it happens: sites show it at `at` + D.
    pub at: ServerTime,
    /// Who asked for it.
    pub author: ParticipantId,
    /// The topology version that it applies to.
    pub topology_version_before: u32,
    /// The topology version after it; the same for what changes no topology.
    pub topology_version_after: u32,
    /// The topology hash after it, to be compared with one's own.
    pub hash_after: TopologyHash,
    /// What is done.
    pub kind: OperationKind,
}

/// What an operation does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum OperationKind {
    /// Cuts the tissue along a stroke.
    Cut(CutStroke),
    /// Somebody came.
    Joined {
        /// Their number.
        participant: ParticipantId,
        /// Their name.
        name: String,
        /// Their role.
        role: Role,
        /// Their tool, where the role has one.
        tool: Option<ToolDescription>,
    },
    /// Somebody went, and their tool with them.
    Left {
        /// Their number.
        participant: ParticipantId,
        /// Why.
        reason: LeaveReason,
    },
    /// The connection of somebody was lost: their tool presses no more, their seat is kept.
    Away {
        /// Their number.
        participant: ParticipantId,
    },
    /// Somebody whose connection was lost is back in their seat.
    Back {
        /// Their number.
        participant: ParticipantId,
    },
    /// Somebody took another tool.
    ToolChanged {
        /// Their number.
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
        /// From when on it is approached, with the slew limits of
        /// [`DelaySchedule`](crate::compensation::DelaySchedule).
        effective_at: ServerTime,
    },
    /// The network of somebody needs more delay than the session allows: their tool presses no more,
    /// their seat is kept, and the others no longer wait for them.
    Demoted {
        /// Their number.
        participant: ParticipantId,
        /// The delay that they need, microseconds.
        wanted_us: u32,
        /// The largest that is waited for, microseconds.
        cap_us: u32,
    },
    /// The network of somebody has recovered: they have their tool again.
    Restored {
        /// Their number.
        participant: ParticipantId,
    },
}

/// A stroke of the blade through the tissue, in the rest frame of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CutStroke {
    /// Where the blade was, in order, at most [`STROKE_MAX_POINTS`].
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
    /// Unit vector from the tip out along the blade, against the depth.
    pub axis: [f64; 3],
    /// How much of the blade, from the tip backwards, is in the tissue, metres.
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

/// Why a participant is no longer here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LeaveReason {
    /// They said so.
    Left,
    /// Nothing was heard from them for the silence limit.
    Silent,
    /// They sent what the protocol does not allow.
    Violation,
    /// Their connection could not take the operations fast enough.
    TooSlow,
    /// The instructor sent them away.
    Removed,
}

/// How the session's artificial delay is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum CompensationMode {
    /// Everything is shown as it comes.
    None,
    /// One delay for the whole session.
    Fixed,
    /// The largest delay that any participant needs, followed over time.
    Adaptive {
        /// The delay never grows beyond this, microseconds; who needs more is told so.
        cap_us: u32,
    },
}

/// The compensation in force when a client joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CompensationSettings {
    /// How the delay is chosen.
    pub mode: CompensationMode,
    /// The delay that the session began with, microseconds; later changes are operations.
    pub initial_delay_us: u32,
}

impl CompensationSettings {
    /// The delay that the session began with.
    pub fn initial_delay(&self) -> Span {
        Span::from_micros(i64::from(self.initial_delay_us))
    }
}
