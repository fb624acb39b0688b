//! Requests that are not answered yet, so that none is lost with a connection.
//!
//! A seat's requests are counted over all its connections. What was not answered when one broke is asked
//! again under its old number, and the server does nothing twice. A cut or a change of the tool is
//! answered by its operation in the log or by a refusal; both come in the order in which was asked.

use std::collections::VecDeque;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{Request, RequestKind, RequestRefusal, RequestRefused};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{OperationId, ParticipantId, RequestId};

/// Requests kept at most: as many as a server takes in a second, and some. Beyond, the oldest is given up.
const KEPT_MAX: usize = 64;

/// Bits of a number that count the requests of one run: at 60 a second these are three days.
const RUN_BITS: u32 = 24;

/// What one seat asked for.
#[derive(Debug, Clone)]
pub struct Requests {
    me: ParticipantId,
    last: RequestId,
    open: VecDeque<Request>,
    /// The first operation of the log that was not seen: those that are sent again answer nothing.
    unseen: OperationId,
}

impl Requests {
    /// Nothing asked for yet.
    pub fn new(me: ParticipantId) -> Self {
        Self {
            me,
            last: RequestId(0),
            open: VecDeque::new(),
            unseen: OperationId(0),
        }
    }

    /// Numbers requests above those that an earlier run in the same seat may have used: the server takes a number that it
    /// knows from an earlier connection for a repetition.
    #[must_use]
    pub fn of_run(self, run: u8) -> Self {
        Self {
            last: RequestId(u32::from(run) << RUN_BITS),
            ..self
        }
    }

    /// Numbers a request, and keeps it until it is answered if it is one whose loss a person would feel.
    pub fn number(&mut self, kind: RequestKind) -> Request {
        self.last = RequestId(self.last.0.wrapping_add(1));
        let id = self.last;
        let request = Request { id, kind };
        if is_felt(&request.kind) {
            if self.open.len() == KEPT_MAX {
                self.open.pop_front();
            }
            self.open.push_back(request.clone());
        }
        request
    }

    /// Whether a refusal is of something whose loss a person would feel. That a report was refused because of
    /// too many requests is nobody's concern: the next one tells more.
    pub fn is_felt(&self, refused: &RequestRefused) -> bool {
        refused.reason == RequestRefusal::TopologyDiffers
            || self.open.iter().any(|r| r.id == refused.id)
    }

    /// Notes what is an answer.
    pub fn handle_event(&mut self, event: &ClientEvent) {
        match event {
            ClientEvent::RequestRefused(refused) => self.open.retain(|r| r.id != refused.id),
            ClientEvent::Operation(operation) => self.handle_operation(operation),
            _ => {}
        }
    }

    fn handle_operation(&mut self, operation: &Operation) {
        if operation.id < self.unseen {
            return;
        }
        self.unseen = operation.id.next();
        let answers = |kind: &RequestKind| {
            matches!(
                (&operation.kind, kind),
                (OperationKind::Cut(_), RequestKind::Cut(_))
                    | (OperationKind::ToolChanged { .. }, RequestKind::SetTool(_))
            )
        };
        if operation.author != self.me {
            return;
        }
        if let Some(i) = self.open.iter().position(|r| answers(&r.kind)) {
            self.open.remove(i);
        }
    }

    /// What is to be asked again over a new connection, oldest first.
    pub fn unanswered(&self) -> Vec<Request> {
        self.open.iter().cloned().collect()
    }

    /// Gives up what is not answered; how many those were.
    pub fn give_up(&mut self) -> u64 {
        let lost = self.open.len() as u64;
        self.open.clear();
        lost
    }
}

/// Whether a person would feel its loss; reports are made again anyway.
pub(crate) fn is_felt(kind: &RequestKind) -> bool {
    matches!(kind, RequestKind::Cut(_) | RequestKind::SetTool(_))
}

#[cfg(test)]
mod tests {
    use palpate_protocol::operation::CutStroke;
    use palpate_protocol::request::CutRequest;
    use palpate_protocol::{ServerTime, TopologyHash};
    use proptest::prelude::*;

    use super::*;

    const ME: ParticipantId = ParticipantId(4);

    fn cut() -> RequestKind {
        RequestKind::Cut(CutRequest {
            points: Vec::new(),
            width_m: 0.0,
        })
    }

    fn done(id: u64, author: ParticipantId) -> ClientEvent {
        ClientEvent::Operation(Operation {
            id: OperationId(id),
            at: ServerTime::ZERO,
            author,
            topology_version_before: 0,
            topology_version_after: 1,
            hash_after: TopologyHash(0),
            kind: OperationKind::Cut(CutStroke {
                points: Vec::new(),
                width_m: 0.0,
            }),
        })
    }

    fn refused(id: u32) -> ClientEvent {
        ClientEvent::RequestRefused(RequestRefused {
            id: RequestId(id),
            reason: RequestRefusal::NothingCut,
        })
    }

    #[test]
    fn two_runs_in_one_seat_use_no_number_twice() {
        let numbers = |run: u8| {
            let mut requests = Requests::new(ME).of_run(run);
            (0..1000).map(move |_| requests.number(cut()).id)
        };
        assert!(numbers(0).max() < numbers(1).min());
        assert!(numbers(254).max() < numbers(255).min());
    }

    #[test]
    fn a_log_that_is_sent_again_answers_nothing_a_second_time() {
        let mut requests = Requests::new(ME);
        requests.number(cut());
        requests.handle_event(&done(0, ME));
        requests.number(cut());
        requests.handle_event(&done(0, ME));
        requests.handle_event(&done(1, ParticipantId(9)));
        assert_eq!(requests.unanswered().len(), 1);
        requests.handle_event(&done(2, ME));
        assert!(requests.unanswered().is_empty());
    }

    #[test]
    fn what_nobody_would_feel_is_numbered_and_not_kept() {
        let mut requests = Requests::new(ME);
        let hash = TopologyHash(0);
        requests.number(RequestKind::TopologyReport { version: 0, hash });
        assert_eq!(requests.number(cut()).id, RequestId(2));
        assert_eq!(requests.unanswered().len(), 1);
        assert_eq!(requests.give_up(), 1);
    }

    #[test]
    fn a_refused_report_is_told_only_where_it_says_that_the_copy_differs() {
        let mut requests = Requests::new(ME);
        let hash = TopologyHash(0);
        let report = requests.number(RequestKind::TopologyReport { version: 0, hash });
        let cut = requests.number(cut());
        let refusal = |id, reason| RequestRefused { id, reason };
        assert!(!requests.is_felt(&refusal(report.id, RequestRefusal::TooMany)));
        assert!(requests.is_felt(&refusal(report.id, RequestRefusal::TopologyDiffers)));
        assert!(requests.is_felt(&refusal(cut.id, RequestRefusal::TooMany)));
    }

    proptest! {
        #[test]
        fn what_is_left_is_what_was_not_answered_whatever_the_answers(
            answers in prop::collection::vec(any::<Option<bool>>(), 0..40),
        ) {
            let mut requests = Requests::new(ME);
            let ids: Vec<RequestId> = answers.iter().map(|_| requests.number(cut()).id).collect();
            // Up to the first that is not answered a server has come.
            let answered = answers.iter().take_while(|a| a.is_some()).count();
            let mut operations = 0;
            for (id, done_or_not) in ids.iter().zip(&answers).take(answered) {
                if *done_or_not == Some(true) {
                    requests.handle_event(&done(operations, ME));
                    operations += 1;
                } else {
                    requests.handle_event(&refused(id.0));
                }
            }
            let left: Vec<RequestId> = requests.unanswered().iter().map(|r| r.id).collect();
            prop_assert_eq!(left, ids[answered..].to_vec());
        }
    }
}
