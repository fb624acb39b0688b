//! What the host decides before anybody joins.

use palpate_protocol::compensation::CAP_DEFAULT;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_protocol::{Epoch, Grant, ModelInfo, ParticipantId, ResumeToken, Role, Span};

/// Most participants at once. A roster must fit one frame, and every tool costs a contact search per
/// tick; beyond it a newcomer is refused politely.
pub const SEATS_MAX: u16 = 64;

/// The settings of one session.
#[derive(Debug, Clone)]
pub struct RoomConfig {
    /// Told apart from an earlier session of the same server; in every datagram.
    pub epoch: Epoch,
    /// Which model, so that clients can fetch and check it.
    pub model: ModelInfo,
    /// The secret that lets somebody in, per role.
    pub grants: Vec<(Role, Grant)>,
    /// Seats, at most [`SEATS_MAX`].
    pub seats: u16,
    /// Ticks per second of the authoritative tissue, and of everybody's view.
    pub tick_hz: u32,
    /// Artificial time compensation.
    pub compensation: CompensationSettings,
    /// Gives the secret with which a participant takes the seat again. Randomness is the shell's: a
    /// service draws it, an experiment derives it from the number, so that one seed replays it.
    pub fresh_token: fn(ParticipantId) -> ResumeToken,
    /// Scripts begin when so many tools are in the session; 0: at once.
    pub start_when_tools: u16,
}

impl RoomConfig {
    /// Length of a tick.
    pub fn tick_period(&self) -> Span {
        Span::from_micros(1_000_000 / i64::from(self.tick_hz.max(1)))
    }

    /// The largest delay that is waited for.
    pub(crate) fn cap(&self) -> Span {
        match self.compensation.mode {
            CompensationMode::Adaptive { cap_us } => Span::from_micros(i64::from(cap_us)),
            CompensationMode::None | CompensationMode::Fixed => CAP_DEFAULT,
        }
    }
}
