//! Data of views beside the log: tools at a time, and the measurements of seats.

use palpate_protocol::{Emulation, ParticipantId, Pose, ServerTime, Span};

use super::Room;
use crate::PeerKey;
use crate::participant::Participant;

/// A participant's tool at one displayed time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolShown {
    /// Its owner.
    pub participant: ParticipantId,
    /// Its pose.
    pub pose: Pose,
    /// One bit per button.
    pub buttons: u8,
    /// Whether it returns from a hold.
    pub returns: bool,
}

/// Measurements of a seat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SeatFigures {
    /// The participant.
    pub id: ParticipantId,
    /// Its connection; `None` while it is lost.
    pub peer: Option<PeerKey>,
    /// The network that the instructor emulates for it.
    pub emulation: Emulation,
    /// The longest round trip of the last half minute; `None` before it is known.
    pub round_trip: Option<Span>,
    /// The delay that its network needs, µs, as far as it is known.
    pub wanted_us: Option<u32>,
}

impl Room {
    /// The active tools at a displayed time. Query in ascending order, like the tissue.
    pub fn tools_at(&mut self, s: ServerTime) -> Vec<ToolShown> {
        let shown = |p: &mut Participant| {
            let (_, shown) = p.shown_at(s)?;
            Some(ToolShown {
                participant: p.id,
                pose: shown.pose,
                buttons: shown.buttons,
                returns: shown.returns,
            })
        };
        self.participants.values_mut().filter_map(shown).collect()
    }

    /// The measurements of all seats, by number.
    pub fn seat_figures(&self) -> Vec<SeatFigures> {
        let figures = |p: &Participant| {
            let uplink = p.explained_uplink().map(|r| r.wanted_us);
            let downlink = p.report.map(|(_, report)| report.wanted_us);
            SeatFigures {
                id: p.id,
                peer: p.peer(),
                emulation: p.emulation,
                round_trip: p.round_trip,
                wanted_us: uplink.max(downlink),
            }
        };
        self.participants.values().map(figures).collect()
    }
}
