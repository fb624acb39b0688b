//! Requests of one seat across connections. A request that is repeated after a reconnect is not executed twice.

use std::collections::VecDeque;

use palpate_protocol::RequestId;
use palpate_protocol::request::RequestRefused;

/// Refusals kept for repetition: as many as a client may have pending.
const REFUSALS_MAX: usize = 64;

/// The requests of one seat.
#[derive(Debug, Default)]
pub(crate) struct RequestHistory {
    newest: Option<RequestId>,
    /// The newest request of an earlier connection. All requests up to it have been answered.
    before: Option<RequestId>,
    refusals: VecDeque<RequestRefused>,
}

/// Whether a request was received before.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Repetition {
    /// First reception: execute it.
    New,
    /// Executed: its operation is in the log.
    Done,
    /// Refused.
    Refused(RequestRefused),
}

impl RequestHistory {
    /// Classifies a received request.
    pub(crate) fn take(&mut self, id: RequestId) -> Repetition {
        if Some(id) > self.before {
            self.newest = self.newest.max(Some(id));
            return Repetition::New;
        }
        let refusal = self.refusals.iter().find(|r| r.id == id);
        refusal.map_or(Repetition::Done, |r| Repetition::Refused(r.clone()))
    }

    /// Stores a refusal for repetition.
    pub(crate) fn note_refusal(&mut self, refused: RequestRefused) {
        if self.refusals.len() == REFUSALS_MAX {
            self.refusals.pop_front();
        }
        self.refusals.push_back(refused);
    }

    /// Marks the change to a new connection.
    pub(crate) fn next_connection(&mut self) {
        self.before = self.newest;
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::request::RequestRefusal;

    use super::*;

    #[test]
    fn only_requests_of_earlier_connections_are_repetitions() {
        let mut history = RequestHistory::default();
        let refused = |n| RequestRefused {
            id: RequestId(n),
            reason: RequestRefusal::NothingCut,
        };
        assert_eq!(history.take(RequestId(1)), Repetition::New);
        history.take(RequestId(2));
        history.note_refusal(refused(2));
        assert_eq!(
            history.take(RequestId(2)),
            Repetition::New,
            "a stream delivers each request once"
        );
        history.next_connection();
        assert_eq!(history.take(RequestId(1)), Repetition::Done);
        assert_eq!(history.take(RequestId(2)), Repetition::Refused(refused(2)));
        assert_eq!(history.take(RequestId(3)), Repetition::New);
    }

    #[test]
    fn stored_refusals_are_bounded() {
        let mut history = RequestHistory::default();
        for n in 0..1000 {
            history.note_refusal(RequestRefused {
                id: RequestId(n),
                reason: RequestRefusal::TooMany,
            });
        }
        assert_eq!(history.refusals.len(), REFUSALS_MAX);
    }
}
