//! Keeps a participant's seat across connections.
//!
//! ```text
//! Connected --lost-----> Waiting --due---> Connecting --welcome--> Connected
//!     |                     ^                  |
//!     |                     +------failed------+
//!     +-------resync of the whole log--------->+
//! ```
//!
//! The waits are those of a [`Backoff`]. A participant without a tool whose seat is gone joins again under its name.
//!
//! The owner of the connections passes its inputs and the time to `handle_*`, calls
//! [`handle_timeout`](Reconnector::handle_timeout) at [`poll_timeout`](Reconnector::poll_timeout), and carries out
//! [`poll_action`](Reconnector::poll_action) until `None`.

use std::collections::VecDeque;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, RefusalReason, Refused, Resume, Welcome};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{Request, RequestKind};
use palpate_protocol::session::{ClientEvent, CloseReason};
use palpate_protocol::{
    ClientTime, Epoch, OperationId, ParticipantId, RequestId, Span, TopologyHash,
};

use super::backoff::{Backoff, Retry};
use super::requests::{Requests, is_felt};

/// Time after the session's `LinkLost` before the client reconnects. The server has then also dropped the connection.
const SILENCE_MAX: Span = Span::from_millis(1000);

/// Wait before the first attempt to reconnect, without jitter.
const WAIT_FIRST: Span = Span::from_millis(250);

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
    /// The failed attempt, while the client waits for the next one.
    pub retry: Option<Retry>,
    /// Number of reconnects.
    pub reconnects: u64,
    /// Number of the participant after it joined again, because its seat was gone.
    pub joined_again_as: Option<ParticipantId>,
    /// Whether the session ended for this client because the server no longer has its seat: it was restarted, or the seat
    /// has expired. A new join may succeed.
    pub is_seat_gone: bool,
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
    /// Number of attempts so far.
    attempts: u32,
    /// Time of the next attempt, or timeout of the present one.
    due: ClientTime,
    backoff: Backoff,
    last_error: Option<String>,
}

/// State machine of one seat. It starts with an established connection.
#[derive(Debug)]
pub struct Reconnector {
    hello: Hello,
    seat: Resume,
    /// Topology version of the snapshot that the log continues. Before it the client has nothing to resume from.
    resumable_from: u32,
    /// Whether the server no longer has the seat, so that the next attempt is a join.
    is_seat_gone: bool,
    /// The session; another one has another log.
    epoch: Epoch,
    /// How long to try to reconnect.
    patience: Span,
    /// Seed of the next outage's jitter.
    seed: u64,
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
    /// Starts after the first welcome, in the `run`-th run of this seat. The `seed` of the waits should differ between
    /// clients.
    pub fn new(hello: Hello, welcome: &Welcome, patience: Span, run: u8, seed: u64) -> Self {
        Self {
            hello,
            seat: Resume::after_welcome(welcome, None),
            resumable_from: resumable_from(welcome),
            is_seat_gone: false,
            epoch: welcome.epoch,
            patience,
            seed,
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
        if operation.topology_version_after >= self.resumable_from {
            self.seat.note(operation);
        }
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
            let mut outage = self.outage(why, now);
            outage.wait_for_next(now);
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
        let outage = self.outage(why, now);
        self.connect(outage, now);
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
            State::Away(outage) if outage.backoff.is_over(now) => {
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
        // A role without a tool also gets a new seat where only the old one had expired.
        let is_same_seat = welcome.resume_token.matches(&self.seat.token);
        let is_new_seat = std::mem::take(&mut self.is_seat_gone) || !is_same_seat;
        if welcome.epoch != self.epoch {
            let why = "the server has begun another session; join again".to_owned();
            self.status.is_seat_gone = true;
            return self.close(CloseReason::ConnectionLost(why), Farewell::Final);
        }
        if is_new_seat {
            self.requests = Requests::new(welcome.participant);
            self.status.joined_again_as = Some(welcome.participant);
        }
        if welcome.first_operation == OperationId(0) {
            self.resync_reason = None;
            self.delay = DelaySchedule::new(&welcome.compensation);
        }
        self.seat = Resume::after_welcome(&welcome, Some(self.seat));
        self.resumable_from = resumable_from(&welcome);
        self.state = State::Connected { silent_until: None };
        self.actions
            .push_back(Action::Deliver(ClientEvent::Welcomed(welcome)));
        if std::mem::take(&mut self.is_link_lost) {
            self.actions
                .push_back(Action::Deliver(ClientEvent::LinkRestored));
        }
        self.status.reconnects += u64::from(self.status.lost.take().is_some());
        self.status.retry = None;
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
        self.fail(error, false, now);
    }

    /// The server refused the attempt. A later one may succeed after a refusal for load, and after the loss of a seat
    /// without a tool. The seat of a tool is not replaced, because the tool would appear again in the middle of a motion.
    pub fn handle_refusal(&mut self, refused: Refused, now: ClientTime) {
        if !matches!(self.state, State::Away(_)) {
            return;
        }
        let can_join_again = !self.is_seat_gone && !self.hello.role.has_tool();
        if refused.reason.is_temporary() {
            self.fail(refused.sentence, true, now);
        } else if refused.reason == RefusalReason::NoSuchSeat && can_join_again {
            self.is_seat_gone = true;
            if let State::Away(outage) = std::mem::replace(&mut self.state, State::Ended) {
                self.connect(outage, now);
            }
        } else {
            self.status.is_seat_gone = refused.reason == RefusalReason::NoSuchSeat;
            self.handle_dead_end(refused.sentence);
        }
    }

    /// The attempt failed, and so would every later one: the server is another one, or ends the session.
    pub fn handle_dead_end(&mut self, sentence: String) {
        self.close(CloseReason::ConnectionLost(sentence), Farewell::Open);
    }

    fn fail(&mut self, error: String, is_busy: bool, now: ClientTime) {
        if let State::Away(outage) = &mut self.state {
            outage.last_error = Some(error.clone());
            outage.wait_for_next(now);
            self.status.retry = Some(Retry {
                is_busy,
                cause: error,
                wait: outage.due - now,
                attempt: outage.attempts + 1,
            });
            // The connection of a resync was not lost before; now it is.
            let why = outage.why.clone();
            self.lose(&why);
        }
    }

    fn outage(&mut self, why: String, now: ClientTime) -> Outage {
        self.seed = self.seed.wrapping_add(1);
        Outage {
            why,
            began: now,
            is_connecting: false,
            attempts: 0,
            due: now,
            backoff: Backoff::new(WAIT_FIRST, self.patience, now, self.seed),
            last_error: None,
        }
    }

    fn connect(&mut self, mut outage: Outage, now: ClientTime) {
        outage.is_connecting = true;
        outage.attempts += 1;
        outage.due = now + ATTEMPT_MAX;
        self.state = State::Away(outage);
        self.status.retry = None;
        let hello = Hello {
            resume: (!self.is_seat_gone).then_some(self.seat),
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

/// The log after a snapshot leaves out changes of the topology before it.
fn resumable_from(welcome: &Welcome) -> u32 {
    welcome.snapshot.map_or(0, |s| s.topology_version)
}

impl Outage {
    /// Waits for the next attempt. Once the patience is over, the wait ends at once.
    fn wait_for_next(&mut self, now: ClientTime) {
        self.is_connecting = false;
        self.due = now + self.backoff.wait(now).unwrap_or(Span::ZERO);
    }
}

#[cfg(test)]
mod tests;
