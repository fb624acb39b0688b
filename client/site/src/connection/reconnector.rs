//! Keeps a participant's seat across connections.
//!
//! ```text
//! Connected --lost-----> Waiting --due---> Connecting --welcome--> Connected
//!     |                     ^                  |
//!     |                     +------failed------+
//!     +-------resync of the whole log--------->+
//! ```
//!
//! The owner of the connections passes its inputs and the time to `handle_*`, calls
//! [`handle_timeout`](Reconnector::handle_timeout) at [`poll_timeout`](Reconnector::poll_timeout), and carries out
//! [`poll_action`](Reconnector::poll_action) until `None`.

use std::collections::VecDeque;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Resume, Welcome};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{Request, RequestKind};
use palpate_protocol::session::{ClientEvent, CloseReason};
use palpate_protocol::{ClientTime, OperationId, RequestId, Span, TopologyHash};

use super::requests::{Requests, is_felt};

/// Time after the session's `LinkLost` before the client reconnects. The server has then also dropped the connection.
const SILENCE_MAX: Span = Span::from_millis(1000);

/// Delay before the first attempt to reconnect; doubled for every further one.
const WAIT_FIRST: Span = Span::from_millis(250);

/// Maximum delay between two attempts.
const WAIT_MAX: Span = Span::from_millis(8000);

/// Timeout of one attempt. Handshake packets are retransmitted after 0.3, 0.6 and 1.2 s; beyond that a new handshake
/// succeeds sooner.
const ATTEMPT_MAX: Span = Span::from_millis(4000);

/// Maximum age of requests that are sent again. Older ones are dropped, because hand and tissue have moved on.
const REPEAT_WITHIN: Span = Span::from_millis(10_000);

/// State of the connection, for the status line.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ConnectionStatus {
    /// Cause while the connection is lost.
    pub lost: Option<String>,
    /// Number of reconnects.
    pub reconnects: u64,
    /// Requests that were dropped without a connection, or not answered in time.
    pub requests_lost: u64,
}

/// Whether a later run can resume the seat of a session that is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Farewell {
    /// The server has released the seat.
    Final,
    /// The server may still hold the seat: it was not reached again.
    Open,
}

/// Action for the owner of the connections.
#[derive(Debug)]
pub enum Action {
    /// Delivers an event to the site.
    Deliver(ClientEvent),
    /// Sends a request over the connection.
    Send(Request),
    /// Drops the connection or the attempt, without a goodbye, which would release the seat.
    Disconnect,
    /// Connects in the seat, with the known schedule of the delay.
    Connect(Box<Hello>, DelaySchedule),
    /// Ends the session; the last action.
    End(Farewell),
}

#[derive(Debug)]
enum State {
    Connected {
        /// End of a silence, after which the connection is lost.
        silent_until: Option<ClientTime>,
    },
    Away(Outage),
    Ended,
}

/// Time without a connection.
#[derive(Debug)]
struct Outage {
    why: String,
    began: ClientTime,
    is_connecting: bool,
    /// Time of the next attempt, or timeout of the present one.
    due: ClientTime,
    /// Delay before the latest attempt.
    wait: Span,
    last_error: Option<String>,
}

/// State machine of one seat. It starts with an established connection.
#[derive(Debug)]
pub struct Reconnector {
    hello: Hello,
    seat: Resume,
    /// How long to try to reconnect.
    patience: Span,
    requests: Requests,
    /// The artificial delay, from the log.
    delay: DelaySchedule,
    state: State,
    /// Whether the site counts the link as lost.
    is_link_lost: bool,
    /// The last request before an absence that was too long to repeat it. It and earlier ones are lost unless the
    /// missing log answers them.
    given_up: Option<RequestId>,
    /// A resync that was requested without a connection.
    resync_reason: Option<String>,
    status: ConnectionStatus,
    actions: VecDeque<Action>,
}

impl Reconnector {
    /// Starts after the first welcome, in the `run`-th run of this seat.
    pub fn new(hello: Hello, welcome: &Welcome, patience: Span, run: u8) -> Self {
        Self {
            hello,
            seat: Resume::after_welcome(welcome, None),
            patience,
            requests: Requests::new(welcome.participant).of_run(run),
            delay: DelaySchedule::new(&welcome.compensation),
            state: State::Connected { silent_until: None },
            is_link_lost: false,
            given_up: None,
            resync_reason: None,
            status: ConnectionStatus::default(),
            actions: VecDeque::new(),
        }
    }

    /// The next action.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// Time of the next call of [`handle_timeout`](Self::handle_timeout).
    pub fn poll_timeout(&self) -> Option<ClientTime> {
        match &self.state {
            State::Connected { silent_until } => *silent_until,
            State::Away(outage) => Some(outage.due),
            State::Ended => None,
        }
    }

    /// Whether a connection serves the session.
    pub fn is_connected(&self) -> bool {
        matches!(self.state, State::Connected { .. })
    }

    /// State of the connection.
    pub fn status(&self) -> &ConnectionStatus {
        &self.status
    }

    /// Processes an event of the connection.
    pub fn handle_event(&mut self, event: ClientEvent, now: ClientTime) {
        let State::Connected { silent_until } = &mut self.state else {
            return;
        };
        match &event {
            ClientEvent::Closed(
                reason @ (CloseReason::ConnectionLost(_) | CloseReason::Silent(_)),
            ) => {
                let why = reason.to_string();
                return self.handle_lost(why, now);
            }
            ClientEvent::LinkLost => {
                *silent_until = Some(now + SILENCE_MAX);
                self.is_link_lost = true;
            }
            ClientEvent::LinkRestored => {
                *silent_until = None;
                self.is_link_lost = false;
            }
            ClientEvent::Operation(operation) => self.note(operation),
            ClientEvent::CaughtUp => {
                if let Some(last) = self.given_up.take() {
                    self.status.requests_lost += self.requests.give_up(last);
                }
            }
            _ => {}
        }
        let is_unnoticed =
            matches!(&event, ClientEvent::RequestRefused(r) if !self.requests.is_felt(r));
        self.requests.handle_event(&event);
        if is_unnoticed {
            return;
        }
        let is_last = matches!(event, ClientEvent::Closed(_));
        self.actions.push_back(Action::Deliver(event));
        if is_last {
            self.end(Farewell::Final);
        }
    }

    /// Records the operation from which the next connection resumes.
    fn note(&mut self, operation: &Operation) {
        self.seat.note(operation);
        match &operation.kind {
            OperationKind::ToolChanged { participant, tool }
                if *participant == self.seat.participant =>
            {
                self.hello.tool = Some(*tool);
            }
            OperationKind::Compensation {
                delay_us,
                effective_at,
            } => self.delay.handle_change(*delay_us, *effective_at),
            _ => {}
        }
    }

    /// Handles the loss of the connection: reconnects after a delay.
    pub fn handle_lost(&mut self, why: String, now: ClientTime) {
        if self.is_connected() {
            self.actions.push_back(Action::Disconnect);
            self.lose(&why);
            let mut outage = Outage::new(why, now);
            outage.wait_for_next(now, self.patience);
            self.state = State::Away(outage);
        }
    }

    /// Requests the whole log, because the replica differs: reconnects at once if connected; otherwise the next attempt
    /// requests it.
    pub fn handle_resync(&mut self, why: String, now: ClientTime) {
        self.seat.next_operation = OperationId(0);
        self.seat.topology_version = 0;
        self.seat.topology_hash = TopologyHash(0);
        match &self.state {
            State::Connected { .. } => {}
            State::Away(outage) => {
                // The present attempt has requested a part of the log.
                self.resync_reason = outage.is_connecting.then_some(why);
                return;
            }
            State::Ended => return,
        }
        self.actions.push_back(Action::Disconnect);
        self.connect(Outage::new(why, now), now);
    }

    /// Numbers and sends a request. Without a connection, or with `has_room` = false, it is lost and takes no number:
    /// a skipped number would count as done once a later one arrives.
    pub fn handle_request(&mut self, kind: RequestKind, has_room: bool) {
        if self.is_connected() && has_room {
            let request = self.requests.number(kind);
            self.actions.push_back(Action::Send(request));
        } else {
            self.status.requests_lost += u64::from(is_felt(&kind));
        }
    }

    /// The participant leaves.
    pub fn handle_leave(&mut self) {
        match self.state {
            State::Connected { .. } => self.end(Farewell::Final),
            State::Away(_) => {
                self.actions.push_back(Action::Disconnect);
                self.close(CloseReason::Left, Farewell::Open);
            }
            State::Ended => {}
        }
    }

    /// An event could not be delivered.
    pub fn handle_overflow(&mut self) {
        let why = "the inbox is full: this machine applies operations too slowly";
        self.close(CloseReason::ConnectionLost(why.to_owned()), Farewell::Final);
    }

    /// Processes the time.
    pub fn handle_timeout(&mut self, now: ClientTime) {
        if self.poll_timeout().is_none_or(|due| now < due) {
            return;
        }
        match std::mem::replace(&mut self.state, State::Ended) {
            connected @ State::Connected { .. } => {
                self.state = connected;
                self.handle_lost("no packet from the server for 2 s".to_owned(), now);
            }
            State::Away(outage) if outage.is_connecting => {
                self.state = State::Away(outage);
                self.actions.push_back(Action::Disconnect);
                self.handle_failure("no answer".to_owned(), now);
            }
            State::Away(outage) if now - outage.began >= self.patience => {
                let error = outage
                    .last_error
                    .map_or(String::new(), |e| format!(": {e}"));
                let why = format!(
                    "{}; reconnecting failed for {} s{error}",
                    outage.why,
                    self.patience.as_secs_f64()
                );
                self.close(CloseReason::ConnectionLost(why), Farewell::Open);
            }
            State::Away(outage) => self.connect(outage, now),
            State::Ended => {}
        }
    }

    /// The attempt succeeded.
    pub fn handle_welcome(&mut self, welcome: Box<Welcome>, now: ClientTime) {
        let State::Away(outage) = &self.state else {
            return;
        };
        let away = now - outage.began;
        if welcome.first_operation == OperationId(0) {
            self.resync_reason = None;
            self.delay = DelaySchedule::new(&welcome.compensation);
        }
        self.seat = Resume::after_welcome(&welcome, Some(self.seat));
        self.state = State::Connected { silent_until: None };
        self.actions
            .push_back(Action::Deliver(ClientEvent::Welcomed(welcome)));
        if std::mem::take(&mut self.is_link_lost) {
            self.actions
                .push_back(Action::Deliver(ClientEvent::LinkRestored));
        }
        self.status.reconnects += u64::from(self.status.lost.take().is_some());
        if away > REPEAT_WITHIN {
            self.given_up = Some(self.requests.last());
        } else {
            let again = self.requests.unanswered().into_iter().map(Action::Send);
            self.actions.extend(again);
        }
        if let Some(why) = self.resync_reason.take() {
            self.handle_resync(why, now);
        }
    }

    /// The attempt failed, and a later one may succeed.
    pub fn handle_failure(&mut self, error: String, now: ClientTime) {
        if let State::Away(outage) = &mut self.state {
            outage.last_error = Some(error);
            outage.wait_for_next(now, self.patience);
            // The connection of a resync was not lost before; now it is.
            let why = outage.why.clone();
            self.lose(&why);
        }
    }

    /// The attempt failed, and so would every later one: the seat was refused, or the server is another one.
    pub fn handle_refusal(&mut self, sentence: String) {
        self.close(CloseReason::ConnectionLost(sentence), Farewell::Open);
    }

    fn connect(&mut self, mut outage: Outage, now: ClientTime) {
        outage.is_connecting = true;
        outage.due = now + ATTEMPT_MAX;
        self.state = State::Away(outage);
        let hello = Hello {
            resume: Some(self.seat),
            ..self.hello.clone()
        };
        self.actions
            .push_back(Action::Connect(Box::new(hello), self.delay.clone()));
    }

    fn lose(&mut self, why: &str) {
        if !std::mem::replace(&mut self.is_link_lost, true) {
            self.actions
                .push_back(Action::Deliver(ClientEvent::LinkLost));
        }
        self.status.lost = Some(why.to_owned());
    }

    fn close(&mut self, reason: CloseReason, farewell: Farewell) {
        self.actions
            .push_back(Action::Deliver(ClientEvent::Closed(reason)));
        self.end(farewell);
    }

    fn end(&mut self, farewell: Farewell) {
        self.state = State::Ended;
        self.actions.push_back(Action::End(farewell));
    }
}

impl Outage {
    fn new(why: String, now: ClientTime) -> Self {
        Self {
            why,
            began: now,
            is_connecting: false,
            due: now,
            wait: Span::ZERO,
            last_error: None,
        }
    }

    /// Waits for the next attempt, twice as long as before the latest one.
    fn wait_for_next(&mut self, now: ClientTime, patience: Span) {
        self.is_connecting = false;
        self.wait = (self.wait + self.wait).clamp(WAIT_FIRST, WAIT_MAX);
        self.due = (now + self.wait).min(self.began + patience);
    }
}

#[cfg(test)]
mod tests;
