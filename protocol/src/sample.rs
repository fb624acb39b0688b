//! Tool samples: poses with times.

use serde::{Deserialize, Serialize};

use crate::datagram::POSITION_MAX_M;
use crate::lateness::Lateness;
use crate::{ClientTime, ParticipantId, ServerTime};

/// A rigid pose in the world frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Position in metres.
    pub position_m: [f64; 3],
    /// Unit quaternion (x, y, z, w).
    pub orientation: [f64; 4],
}

impl Pose {
    /// The origin, not rotated.
    pub const IDENTITY: Self = Self {
        position_m: [0.0; 3],
        orientation: [0.0, 0.0, 0.0, 1.0],
    };
}

impl Pose {
    /// Whether the position is in range and the quaternion a unit quaternion.
    pub fn is_valid(&self) -> bool {
        let norm = self.orientation.iter().map(|q| q * q).sum::<f64>();
        self.position_m.iter().all(|x| x.abs() <= POSITION_MAX_M) && (norm - 1.0).abs() < 1e-3
    }
}

impl Default for Pose {
    fn default() -> Self {
        Self::IDENTITY
    }
}

/// One sample of one tool with the time of its measurement: in server time, or in client time before it
/// leaves that client ([`LocalSample`]).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolSample<T = ServerTime> {
    /// The time of measurement.
    pub time: T,
    /// The pose of the tool.
    pub pose: Pose,
    /// One bit per button; bit 0 is the main one, [`INSERTED_BUTTON`](crate::tool::INSERTED_BUTTON) is no button.
    pub buttons: u8,
    /// The force that the participant felt, newtons, world frame, where known.
    pub force_n: Option<[f64; 3]>,
}

/// A sample on the clock of the client that took it.
pub type LocalSample = ToolSample<ClientTime>;

/// Some samples of one participant's tool, oldest first.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ToolTrack {
    /// The participant that holds the tool.
    pub participant: ParticipantId,
    /// The samples, oldest first, at most [`crate::datagram::TRACK_MAX_SAMPLES`].
    pub samples: Vec<ToolSample>,
    /// The lateness that machines caused, apart from the network.
    pub late: Lateness,
}
