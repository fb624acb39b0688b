//! The resume tokens of all seats, for the network tasks that serve the model.

use std::sync::{Arc, PoisonError, RwLock};

use palpate_protocol::{ParticipantId, ResumeToken};

/// The tokens as of the last change of the participants. Its size is that of the session.
#[derive(Clone, Default)]
pub(super) struct SeatTokens {
    seats: Arc<RwLock<Vec<(ParticipantId, ResumeToken)>>>,
}

impl SeatTokens {
    /// Replaces the tokens.
    pub(super) fn set(&self, seats: impl Iterator<Item = (ParticipantId, ResumeToken)>) {
        let seats = seats.collect();
        *self.seats.write().unwrap_or_else(PoisonError::into_inner) = seats;
    }

    /// Whether the participant has a seat with this token. The comparison takes constant time.
    pub(super) fn has(&self, participant: ParticipantId, token: &ResumeToken) -> bool {
        let seats = self.seats.read().unwrap_or_else(PoisonError::into_inner);
        let mut own = seats.iter().filter(|(id, _)| *id == participant);
        own.any(|(_, known)| known.matches(token))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn token_belongs_to_its_participant_for_as_long_as_the_seat() {
        let tokens = SeatTokens::default();
        let (ann, bob) = (ParticipantId(1), ParticipantId(2));
        let (hers, his) = (ResumeToken([1; 16]), ResumeToken([2; 16]));
        tokens.set([(ann, hers), (bob, his)].into_iter());
        assert!(tokens.has(ann, &hers) && tokens.has(bob, &his));
        assert!(!tokens.has(ann, &his) && !tokens.has(ParticipantId(3), &hers));
        tokens.set([(bob, his)].into_iter());
        assert!(!tokens.has(ann, &hers));
    }
}
