//! Unanswered requests, kept so that none is lost with a connection.
//!
//! Requests of a seat are numbered across its connections. Unanswered requests are sent again with their old number,
//! and the server executes each number once. A cut is answered by its operation in the log or by
//! a refusal, in request order.

use std::collections::VecDeque;

use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{Request, RequestKind, RequestRefusal, RequestRefused};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{OperationId, ParticipantId, RequestId};

use super::stroke_refusals::StrokeRefusals;

/// Maximum number of kept requests: those of three seconds, so that a stroke survives until a lost connection is noticed.
/// Beyond it the oldest is dropped.
const KEPT_MAX: usize = 128;

/// Bits that count the requests of one run: three days at 60 per second.
const RUN_BITS: u32 = 24;

/// Requests of one seat.
#[derive(Debug, Clone)]
pub(super) struct Requests {
    me: ParticipantId,
    last: RequestId,
    open: VecDeque<Request>,
    /// Latest requests that are not repeated, but whose refusal the user must see.
    unrepeated: VecDeque<RequestId>,
    strokes: StrokeRefusals,
    /// The first log operation not seen yet; repeated operations answer nothing.
    unseen: OperationId,
}

impl Requests {
    /// Starts without requests.
    pub(super) fn new(me: ParticipantId) -> Self {
        Self {
            me,
            last: RequestId(0),
            open: VecDeque::new(),
            unrepeated: VecDeque::new(),
            strokes: StrokeRefusals::default(),
            unseen: OperationId(0),
        }
    }

    /// Numbers requests above those of earlier runs in the same seat: the server treats a known number from an
    /// earlier connection as a repetition.
    #[must_use]
    pub(super) fn of_run(self, run: u8) -> Self {
        Self {
            last: RequestId(u32::from(run) << RUN_BITS),
            ..self
        }
    }

    /// Numbers a request. It is kept until answered if the user would notice its loss.
    pub(super) fn number(&mut self, kind: RequestKind) -> Request {
        self.last = RequestId(self.last.0.wrapping_add(1));
        let id = self.last;
        if let RequestKind::Cut(part) = &kind {
            self.strokes.note_sent(id, part);
        }
        let request = Request { id, kind };
        if is_felt(&request.kind) {
            if self.open.len() == KEPT_MAX {
                self.open.pop_front();
            }
            self.open.push_back(request.clone());
        }
        if matches!(
            request.kind,
            RequestKind::SetTool(_) | RequestKind::Control(_)
        ) {
            if self.unrepeated.len() == KEPT_MAX {
                self.unrepeated.pop_front();
            }
            self.unrepeated.push_back(id);
        }
        request
    }

    /// Whether the user would notice the refused request. A refused report is ignored, because the next one replaces
    /// it.
    pub(super) fn is_felt(&mut self, refused: &RequestRefused) -> bool {
        refused.reason == RequestRefusal::TopologyDiffers
            || self.unrepeated.contains(&refused.id)
            || (self.open.iter().any(|r| r.id == refused.id) && self.strokes.is_shown(refused))
    }

    /// Processes an event that may answer a request.
    pub(super) fn handle_event(&mut self, event: &ClientEvent) {
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
        if operation.author == self.me
            && let OperationKind::Cut(part) = &operation.kind
        {
            self.strokes.note_cut(part);
            // Only cuts are open, and the server answers them in order. A snapshot can contain the answers of earlier
            // strokes.
            let is_earlier =
                |r: &Request| matches!(&r.kind, RequestKind::Cut(cut) if cut.began < part.began);
            while self.open.front().is_some_and(is_earlier) {
                self.open.pop_front();
            }
            self.open.pop_front();
        }
    }

    /// Requests to repeat on a new connection, oldest first.
    pub(super) fn unanswered(&self) -> Vec<Request> {
        self.open.iter().cloned().collect()
    }

    /// Number of the latest request.
    pub(super) fn last(&self) -> RequestId {
        self.last
    }

    /// Drops the unanswered requests up to the number `last` and returns how many they are.
    pub(super) fn give_up(&mut self, last: RequestId) -> u64 {
        let before = self.open.len();
        self.open.retain(|r| r.id > last);
        (before - self.open.len()) as u64
    }
}

/// Whether the user would notice its loss; reports are repeated anyway.
pub(super) fn is_felt(kind: &RequestKind) -> bool {
    matches!(kind, RequestKind::Cut(_))
}

#[cfg(test)]
mod tests {
    use palpate_protocol::control::Control;
    use palpate_protocol::operation::CutStroke;
    use palpate_protocol::request::CutRequest;
    use palpate_protocol::{ServerTime, TopologyHash};
    use proptest::prelude::*;

    use super::*;

    const ME: ParticipantId = ParticipantId(4);

    fn cut() -> RequestKind {
        RequestKind::Cut(CutRequest::whole(Vec::new(), 0.0))
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
                began: ServerTime::ZERO,
                joins: false,
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
    fn runs_in_one_seat_use_distinct_numbers() {
        let numbers = |run: u8| {
            let mut requests = Requests::new(ME).of_run(run);
            (0..1000).map(move |_| requests.number(cut()).id)
        };
        assert!(numbers(0).max() < numbers(1).min());
        assert!(numbers(254).max() < numbers(255).min());
    }

    #[test]
    fn repeated_log_answers_nothing() {
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
    fn reports_are_numbered_and_not_kept() {
        let mut requests = Requests::new(ME);
        let hash = TopologyHash(0);
        requests.number(RequestKind::TopologyReport { version: 0, hash });
        assert_eq!(requests.number(cut()).id, RequestId(2));
        assert_eq!(requests.unanswered().len(), 1);
        assert_eq!(requests.give_up(requests.last()), 1);
    }

    #[test]
    fn refused_control_is_shown_and_not_repeated() {
        let mut requests = Requests::new(ME);
        let control = requests.number(RequestKind::Control(Control::Undo));
        assert!(requests.unanswered().is_empty());
        assert!(requests.is_felt(&RequestRefused {
            id: control.id,
            reason: RequestRefusal::NothingToUndo,
        }));
    }

    #[test]
    fn refused_report_is_shown_only_for_topology_difference() {
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
        fn unanswered_requests_remain(
            answers in prop::collection::vec(any::<Option<bool>>(), 0..40),
        ) {
            let mut requests = Requests::new(ME);
            let ids: Vec<RequestId> = answers.iter().map(|_| requests.number(cut()).id).collect();
            // The server has processed requests up to the first unanswered one.
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
