//! What a seat has asked for, so that what is asked again over a new connection is not done twice.

use std::collections::VecDeque;

use palpate_protocol::RequestId;
use palpate_protocol::request::RequestRefused;

/// Refusals kept to be said again: as many as a client may have open.
const REFUSALS_MAX: usize = 64;

/// The requests of one seat.
#[derive(Debug, Default)]
pub(crate) struct Asked {
    newest: Option<RequestId>,
    /// The newest of an earlier connection: up to it everything was answered already.
    before: Option<RequestId>,
    refusals: VecDeque<RequestRefused>,
}

/// Whether a request was there before.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Repetition {
    /// It was not, and is to be done.
    New,
    /// It was done: its operation is in the log.
    Done,
    /// It was refused.
    Refused(RequestRefused),
}

impl Asked {
    /// A request comes.
    pub(crate) fn take(&mut self, id: RequestId) -> Repetition {
        if Some(id) > self.before {
            self.newest = self.newest.max(Some(id));
            return Repetition::New;
        }
        let refusal = self.refusals.iter().find(|r| r.id == id);
        refusal.map_or(Repetition::Done, |r| Repetition::Refused(r.clone()))
    }

    /// One was refused.
    pub(crate) fn note_refusal(&mut self, refused: RequestRefused) {
        if self.refusals.len() == REFUSALS_MAX {
            self.refusals.pop_front();
        }
        self.refusals.push_back(refused);
    }

    /// Another connection takes the place of the one before.
    pub(crate) fn next_connection(&mut self) {
        self.before = self.newest;
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::request::RequestRefusal;

    use super::*;

    #[test]
    fn only_what_an_earlier_connection_brought_is_a_repetition() {
        let mut asked = Asked::default();
        let refused = |n| RequestRefused {
            id: RequestId(n),
            reason: RequestRefusal::NothingCut,
        };
        assert_eq!(asked.take(RequestId(1)), Repetition::New);
        asked.take(RequestId(2));
        asked.note_refusal(refused(2));
        assert_eq!(
            asked.take(RequestId(2)),
            Repetition::New,
            "the stream repeats nothing"
        );
        asked.next_connection();
        assert_eq!(asked.take(RequestId(1)), Repetition::Done);
        assert_eq!(asked.take(RequestId(2)), Repetition::Refused(refused(2)));
        assert_eq!(asked.take(RequestId(3)), Repetition::New);
    }

    #[test]
    fn refusals_do_not_grow() {
        let mut asked = Asked::default();
        for n in 0..1000 {
            asked.note_refusal(RequestRefused {
                id: RequestId(n),
                reason: RequestRefusal::TooMany,
            });
        }
        assert_eq!(asked.refusals.len(), REFUSALS_MAX);
    }
}
