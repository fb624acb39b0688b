//! Settings of a session, fixed before the first participant joins.

use palpate_protocol::operation::CompensationSettings;
use palpate_protocol::{Epoch, Grant, ModelInfo, ParticipantId, ResumeToken, Role, Span};

use crate::joins::RoleClass;

/// Maximum number of participants. A roster must fit one frame, and every tool costs a contact search per
/// tick. Further clients are refused.
pub const SEATS_MAX: u16 = 64;

/// The settings of one session.
#[derive(Debug, Clone)]
pub struct RoomConfig {
    /// Distinguishes this session from earlier ones of the same server; part of every datagram.
    pub epoch: Epoch,
    /// Hash and size of the model, for download and check by clients.
    pub model: ModelInfo,
    /// The secret of the join link, per role.
    pub grants: Vec<(Role, Grant)>,
    /// Seats, at most [`SEATS_MAX`]. With more than two, one is for an instructor if the session has a grant for one.
    pub seats: u16,
    /// How many of the seats spectators and recorders may take together.
    pub spectators: u16,
    /// Ticks per second of the authoritative tissue and of all views.
    pub tick_hz: u32,
    /// Playout delay.
    pub compensation: CompensationSettings,
    /// Returns the resume token of a participant. The server draws a random token; an experiment derives it from
    /// the id, so that a seed reproduces the session.
    pub fresh_token: fn(ParticipantId) -> ResumeToken,
    /// Returns the grant of an invitation by its number. The server draws a random grant, which can not be guessed.
    pub fresh_grant: fn(u32) -> Grant,
    /// Start scripts once this many tools have joined; 0: at once.
    pub start_when_tools: u16,
}

impl RoomConfig {
    /// Length of a tick.
    pub fn tick_period(&self) -> Span {
        Span::from_micros(1_000_000 / i64::from(self.tick_hz.max(1)))
    }

    /// The classes of roles that share seats with a class, and the seats that they may take together.
    pub(crate) fn limits_of(&self, class: RoleClass) -> Vec<(&'static [RoleClass], u16)> {
        use RoleClass::{Instructors, Observers, Trainees};
        let seats = self.seats.min(SEATS_MAX);
        let has_instructor = self.grants.iter().any(|(r, _)| *r == Role::Instructor);
        let reserved = u16::from(has_instructor && seats > 2);
        let mut limits: Vec<(&[RoleClass], u16)> =
            vec![(&[Instructors, Trainees, Observers], seats)];
        if class != Instructors {
            limits.push((&[Trainees, Observers], seats - reserved));
        }
        if class == Observers {
            limits.push((&[Observers], self.spectators));
        }
        limits
    }

    /// The largest playout delay. A participant that needs more is demoted.
    pub(crate) fn cap(&self) -> Span {
        self.compensation.mode.cap()
    }
}
