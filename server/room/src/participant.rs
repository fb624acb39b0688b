//! One seat of the session.

use palpate_protocol::compensation::{DelayEstimator, DelayRule};
use palpate_protocol::handshake::{RosterEntry, ToolDescription, ToolKind};
use palpate_protocol::timeline::Timeline;
use palpate_protocol::{ParticipantId, Role, ServerTime};
use palpate_tissue::{Tool, Vec3};

use crate::PeerKey;

/// Bit of the primary button in a sample.
const PRIMARY_BUTTON: u8 = 1;

/// Somebody in the session.
#[derive(Debug)]
pub(crate) struct Participant {
    pub(crate) peer: PeerKey,
    pub(crate) id: ParticipantId,
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) tool: Option<ToolDescription>,
    /// Where the tool was, for the server's own view.
    pub(crate) timeline: Timeline,
    /// How late its samples come.
    pub(crate) delay: DelayEstimator,
}

impl Participant {
    pub(crate) fn new(
        peer: PeerKey,
        id: ParticipantId,
        name: String,
        role: Role,
        tool: Option<ToolDescription>,
    ) -> Self {
        Self {
            peer,
            id,
            name,
            role,
            tool,
            timeline: Timeline::default(),
            delay: DelayEstimator::new(DelayRule::MeanDeviation),
        }
    }

    pub(crate) fn roster_entry(&self) -> RosterEntry {
        RosterEntry {
            participant: self.id,
            name: self.name.clone(),
            role: self.role,
            tool: self.tool,
        }
    }

    /// The tool as it presses at a moment; `None` when it has none, nothing is known of it, it has
    /// been silent for too long, or it is a blade that is cutting and so goes through.
    pub(crate) fn pressing_at(&mut self, t: ServerTime) -> Option<Tool> {
        let description = self.tool?;
        let shown = self.timeline.at(t)?;
        let cuts = description.kind == ToolKind::Scalpel && shown.buttons & PRIMARY_BUTTON != 0;
        (!shown.stale && !cuts).then(|| {
            Tool::ball(
                u32::from(self.id.0),
                Vec3::from(shown.pose.position_m),
                description.radius_m,
            )
        })
    }
}
