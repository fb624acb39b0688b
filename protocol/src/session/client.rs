//! The client's end of a session.

mod catch_up;
mod clock_step;
mod incoming_snapshot;
mod outgoing;
mod resumption;

use std::collections::VecDeque;

use crate::clock::{ClockEstimate, ClockMap};
use crate::codec::{self, FrameDecoder};
use crate::compensation::{DelayEstimator, DelaySchedule, MotionArrival, REPORT_OLD};
use crate::datagram::{Body, Header};
use crate::handshake::{Hello, PROTOCOL_VERSION, Preamble, ROSTER_MAX, RefusalReason, Refused};
use crate::lateness::LONG_STALL;
use crate::request::{ClientMessage, Request, RequestKind, ServerMessage};
use crate::session::copies::{IncomingCopies, OutgoingCopies};
use crate::session::motion_batch::MotionBatch;
use crate::session::outbox::Outbox;
use crate::session::preamble::PreambleReader;
use crate::session::{
    ClientEvent, CloseReason, EVENTS_MAX, HANDSHAKE_TIMEOUT, Link, LinkStats, MessageCopy,
    SERVER_SILENCE,
};
use crate::{
    ClientTime, LocalSample, OperationId, ParticipantId, ProtocolError, RequestId, ServerTime,
    Span, ToolTrack,
};
use incoming_snapshot::IncomingSnapshot;
use outgoing::Pending;

/// Between clock probes until the clock is locked.
pub const PROBE_PERIOD_FIRST: Span = Span::from_millis(20);

/// Between clock probes afterwards. They are also the client's heartbeat.
pub const PROBE_PERIOD: Span = Span::from_millis(100);

/// Between reports of the delay estimate.
pub const DELAY_REPORT_PERIOD: Span = Span::from_millis(250);

enum State {
    /// Waits for the server's preamble.
    Preamble(PreambleReader),
    /// Waits for the welcome.
    Hello,
    Joined(Box<Joined>),
    Closed,
}

#[cfg(test)]
impl ClientSession {
    /// The states, as named in STATES.md.
    pub(super) const STATES: [&str; 4] = ["Preamble", "Hello", "Joined", "Closed"];

    pub(super) fn state_name(&self) -> &'static str {
        match self.state {
            State::Preamble(_) => Self::STATES[0],
            State::Hello => Self::STATES[1],
            State::Joined(_) => Self::STATES[2],
            State::Closed => Self::STATES[3],
        }
    }
}

struct Joined {
    participant: ParticipantId,
    next_operation: OperationId,
    /// How long the log was at the welcome; `None` once all that was in it has arrived.
    catch_up: Option<u64>,
    /// The snapshot that is arriving.
    snapshot: Option<IncomingSnapshot>,
    schedule: DelaySchedule,
    newest_shown: Vec<(ParticipantId, ServerTime)>,
    /// The last arrival of motion of another participant's tool.
    last_motion_at: ClientTime,
}

/// The client's end of a session, see [`crate::session`] for the calling order. Created with a [`Hello`], it writes the
/// preamble and the hello at once. After [`ClientEvent::Closed`] it does nothing.
pub struct ClientSession {
    state: State,
    decoder: FrameDecoder<ServerMessage>,
    outbox: Outbox,
    copies: OutgoingCopies,
    incoming: IncomingCopies<ServerMessage>,
    link: Link,
    clock: ClockEstimate,
    delay: DelayEstimator,
    motion: MotionBatch,
    events: VecDeque<ClientEvent>,
    last_request: u32,
    /// The log position from which a resumed seat continues.
    resumes_at: Option<OperationId>,
    resumed_schedule: Option<DelaySchedule>,
    started: ClientTime,
    last_received: ClientTime,
    link_lost: bool,
    probe_due: ClientTime,
    /// The content for the next packet.
    pending: Pending,
    report_due: ClientTime,
}

impl ClientSession {
    /// Begins the handshake. An error only where the hello itself can not be encoded.
    pub fn new(hello: Hello, now: ClientTime) -> Result<Self, ProtocolError> {
        let mut outbox = Outbox::default();
        outbox.push_bytes(Preamble::OURS.to_bytes().to_vec())?;
        let resumes_at = hello.resume.map(|r| r.next_operation);
        let frame = codec::encode_frame(&ClientMessage::Hello(hello))?;
        if frame.len() > codec::HELLO_MAX_BYTES {
            return Err(ProtocolError::TooLarge {
                what: "hello",
                bytes: frame.len(),
                limit: codec::HELLO_MAX_BYTES,
            });
        }
        let mut copies = OutgoingCopies::default();
        copies.push(&frame, None);
        outbox.push_bytes(frame)?;
        Ok(Self {
            state: State::Preamble(PreambleReader::default()),
            decoder: FrameDecoder::new(codec::FRAME_MAX_BYTES),
            outbox,
            copies,
            incoming: IncomingCopies::default(),
            link: Link::default(),
            clock: ClockEstimate::new(),
            delay: DelayEstimator::default(),
            motion: MotionBatch::default(),
            events: VecDeque::new(),
            last_request: 0,
            resumes_at,
            resumed_schedule: None,
            started: now,
            last_received: now,
            link_lost: false,
            probe_due: now,
            pending: Pending::default(),
            report_due: now,
        })
    }

    /// Bytes of the operations stream, in any pieces.
    pub fn handle_stream(&mut self, bytes: &[u8], now: ClientTime) {
        self.follow_clock(now);
        if let Err(error) = self.read_stream(bytes, now) {
            self.close(CloseReason::Violation(error));
        }
    }

    fn read_stream(&mut self, mut bytes: &[u8], now: ClientTime) -> Result<(), ProtocolError> {
        if let State::Preamble(reader) = &mut self.state {
            let Some(opening) = reader.push(bytes)? else {
                return Ok(());
            };
            bytes = &bytes[bytes.len() - opening.left_over..];
            let theirs = opening.preamble.version;
            if theirs != PROTOCOL_VERSION {
                let reason = RefusalReason::Version {
                    server_speaks: theirs,
                };
                self.close(CloseReason::Refused(Refused::because(reason)));
                return Ok(());
            }
            if let Some(sentence) = opening.sentence {
                self.close(CloseReason::Goodbye(sentence));
                return Ok(());
            }
            self.state = State::Hello;
        }
        self.note_received(now);
        self.decoder.push(bytes);
        while !matches!(self.state, State::Closed) {
            let Some(message) = self.decoder.next()? else {
                return Ok(());
            };
            if self.incoming.is_new() {
                self.handle_message(message, now)?;
                self.handle_early(now)?;
            }
        }
        Ok(())
    }

    /// Messages whose copies are there and that follow the last one.
    fn handle_early(&mut self, now: ClientTime) -> Result<(), ProtocolError> {
        while !matches!(self.state, State::Closed)
            && let Some(message) = self.incoming.pop()
        {
            self.handle_message(message, now)?;
        }
        Ok(())
    }

    fn handle_copy(
        &mut self,
        (number, message): MessageCopy,
        now: ClientTime,
    ) -> Result<(), ProtocolError> {
        match codec::decode_body(&message) {
            Ok(message) => self.incoming.push(number, message),
            Err(_) => self.link.count_malformed(),
        }
        self.handle_early(now)
    }

    fn handle_message(
        &mut self,
        message: ServerMessage,
        now: ClientTime,
    ) -> Result<(), ProtocolError> {
        let out_of_order = |what, state| Err(ProtocolError::OutOfOrder { what, state });
        match (&self.state, message) {
            (State::Hello, ServerMessage::Welcome(welcome)) => self.join(welcome, now)?,
            (State::Hello, ServerMessage::Refused(refused)) => {
                self.close(CloseReason::Refused(refused));
            }
            (_, ServerMessage::Goodbye { sentence }) => {
                self.close(CloseReason::Goodbye(sentence));
            }
            (State::Joined(_), ServerMessage::Operation(operation)) => {
                self.handle_operation(operation)?;
            }
            (State::Joined(_), ServerMessage::Snapshot(piece)) => self.handle_snapshot(&piece)?,
            (State::Joined(_), ServerMessage::RequestRefused(refused)) => {
                self.emit(ClientEvent::RequestRefused(refused));
            }
            (State::Joined(_), ServerMessage::Invitation(invitation)) => {
                self.emit(ClientEvent::Invitation(invitation));
            }
            (State::Joined(_), ServerMessage::Welcome(_) | ServerMessage::Refused(_)) => {
                return out_of_order(
                    "second answer to the hello",
                    "the session is already established",
                );
            }
            _ => return out_of_order("server message", "the hello is not answered"),
        }
        Ok(())
    }

    /// One datagram. Noise is counted and otherwise ignored.
    pub fn handle_datagram(&mut self, bytes: &[u8], now: ClientTime) {
        self.handle_waiting_datagram(bytes, Span::ZERO, now);
    }

    /// The same for a datagram that may have waited for `stall`, because this machine stalled
    /// ([`StallDetector`](crate::lateness::StallDetector)).
    pub fn handle_waiting_datagram(&mut self, bytes: &[u8], stall: Span, now: ClientTime) {
        self.follow_clock(now);
        let Some(datagram) = self.link.accept(bytes) else {
            return;
        };
        self.link.count_stall(stall);
        self.note_received(now);
        match datagram.body {
            Body::Motion(tracks) => self.handle_motion(&datagram.header, tracks, stall, now),
            Body::Corrections(c) => self.emit(ClientEvent::Corrections(c)),
            Body::Displacements(d) => self.emit(ClientEvent::Displacements(d)),
            // Its round trip would include this machine's stall.
            Body::Reply(_) if stall > LONG_STALL => {}
            Body::Reply(reply) => self.handle_reply(reply, now),
            Body::Delays(list) => self.emit(ClientEvent::Delays(list)),
            Body::Copy(copy) => {
                if let Err(error) = self.handle_copy(copy, now) {
                    self.close(CloseReason::Violation(error));
                }
            }
            Body::Probe(_) => self.link.count_misdirected(),
        }
        // A client without motion would acknowledge only with the next clock probe, too late to cover
        // all datagrams.
        self.pending.acknowledgement |= self.link.owes_acknowledgement();
    }

    fn handle_motion(
        &mut self,
        header: &Header,
        tracks: Vec<ToolTrack>,
        stall: Span,
        now: ClientTime,
    ) {
        let State::Joined(joined) = &mut self.state else {
            return;
        };
        let arrived = self.clock.map().map(|map| map.to_server(now));
        // The age of a datagram is that of its oldest news.
        let mut oldest: Option<MotionArrival> = None;
        let mut has_newer = false;
        for track in &tracks {
            let Some(newest) = track.samples.last().map(|s| s.time) else {
                continue;
            };
            let known = joined
                .newest_shown
                .iter_mut()
                .find(|(p, _)| *p == track.participant);
            let is_newer = match known {
                Some((_, seen)) if *seen >= newest => false,
                Some((_, seen)) => {
                    *seen = newest;
                    true
                }
                None => {
                    // Bounded, so that forged participants can not fill the memory.
                    if joined.newest_shown.len() < ROSTER_MAX {
                        joined.newest_shown.push((track.participant, newest));
                    }
                    true
                }
            };
            has_newer |= is_newer;
            let Some(arrived) = arrived.filter(|_| is_newer) else {
                continue;
            };
            let motion = MotionArrival {
                // A sample is at least as old as its datagram.
                generated: newest.min(header.generated),
                arrived,
                late: track.late,
                stall,
            };
            if oldest.is_none_or(|o| o.age() < motion.age()) {
                oldest = Some(motion);
            }
        }
        if has_newer {
            joined.last_motion_at = now;
        }
        if let Some(motion) = oldest {
            self.delay.handle_arrival(motion);
            if self.delay.take_urgent() {
                self.report_due = now;
            }
        }
        for track in tracks {
            self.emit(ClientEvent::Motion(track));
        }
    }

    /// Call at the time of [`poll_timeout`](Self::poll_timeout); an earlier call does no harm.
    pub fn handle_timeout(&mut self, now: ClientTime) {
        self.follow_clock(now);
        self.enqueue_copies(now);
        match &self.state {
            State::Closed => {}
            State::Preamble(_) | State::Hello => {
                if now - self.started >= HANDSHAKE_TIMEOUT {
                    self.close(CloseReason::HandshakeTimeout);
                }
            }
            State::Joined(joined) => {
                let participant = joined.participant;
                if now >= self.probe_due {
                    self.pending.probe = true;
                    let locked = self.clock.map().is_some();
                    self.probe_due = now
                        + self.clock.probe_pause(if locked {
                            PROBE_PERIOD
                        } else {
                            PROBE_PERIOD_FIRST
                        });
                }
                if now >= self.report_due {
                    self.report_due = now + DELAY_REPORT_PERIOD;
                    // Without motion from other participants there is no delay estimate.
                    let is_fresh = now - joined.last_motion_at <= REPORT_OLD;
                    if let Some(report) = self.delay.report().filter(|_| is_fresh) {
                        let since = self
                            .clock
                            .map()
                            .map_or(ServerTime::ZERO, |m| m.to_server(now));
                        self.link
                            .enqueue(Body::Delays(vec![(participant, report)]), since);
                    }
                }
                if !self.link_lost && now - self.last_received >= SERVER_SILENCE {
                    self.link_lost = true;
                    self.emit(ClientEvent::LinkLost);
                }
            }
        }
    }

    /// The connection of the session is lost.
    pub fn handle_disconnect(&mut self, why: String) {
        self.close(CloseReason::ConnectionLost(why));
    }

    /// The server ended the session with the close frame of the connection only.
    pub fn handle_goodbye(&mut self, sentence: String) {
        self.close(CloseReason::Goodbye(sentence));
    }

    /// Takes one sample of the client's own tool, oldest first; samples leave in batches of four. A
    /// sample that is not finite or out of range is rejected and counted.
    pub fn send_motion(&mut self, sample: LocalSample) {
        if !self.motion.push(sample) {
            self.link.count_refused_samples(1);
        }
    }

    /// Sends a request; the answer is an operation, or [`ClientEvent::RequestRefused`].
    pub fn request(&mut self, kind: RequestKind) -> Result<RequestId, ProtocolError> {
        let id = RequestId(self.last_request.wrapping_add(1));
        self.send_request(Request { id, kind })?;
        Ok(id)
    }

    /// Sends a request with a number from the caller: a resumed client continues its numbering, and
    /// repeats unanswered requests under their old numbers.
    pub fn send_request(&mut self, request: Request) -> Result<(), ProtocolError> {
        if !matches!(self.state, State::Joined(_)) {
            return Err(ProtocolError::OutOfOrder {
                what: "request",
                state: "the session does not stand",
            });
        }
        if !request.kind.is_valid() {
            return Err(ProtocolError::OutOfRange {
                what: "a request",
                detail: "its numbers are not finite, not ordered or too large".to_owned(),
            });
        }
        let leaving = request.kind == RequestKind::Leave;
        let id = request.id.0;
        let frame = codec::encode_frame(&ClientMessage::Request(request))?;
        let loss = self.link.loss_out();
        self.copies.push(&frame[codec::PREFIX_BYTES..], Some(loss));
        self.outbox.push_bytes(frame)?;
        self.last_request = self.last_request.max(id);
        if leaving {
            self.close(CloseReason::Left);
        }
        Ok(())
    }

    /// Bytes for the operations stream, in order.
    pub fn poll_stream(&mut self) -> Option<Vec<u8>> {
        self.outbox.pop()
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<ClientEvent> {
        self.events.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due; `None` once closed.
    pub fn poll_timeout(&self) -> Option<ClientTime> {
        match &self.state {
            State::Closed => None,
            State::Preamble(_) | State::Hello => Some(self.started + HANDSHAKE_TIMEOUT),
            State::Joined(_) => {
                let due = self.probe_due.min(self.report_due);
                let copy = self.copies.due().map(|due| ClientTime::ZERO + due);
                let due = copy.map_or(due, |copy| due.min(copy));
                let silence = self.last_received + SERVER_SILENCE;
                Some(if self.link_lost {
                    due
                } else {
                    due.min(silence)
                })
            }
        }
    }

    /// Whether the session is over. The shell still sends the rest that
    /// [`poll_stream`](Self::poll_stream) returns.
    pub fn is_closed(&self) -> bool {
        matches!(self.state, State::Closed)
    }

    /// The map from the client's clock to the server's; `None` until it is locked.
    pub fn clock(&self) -> Option<ClockMap> {
        self.clock.map()
    }

    /// The artificial delay D at a moment of server time; zero before the welcome.
    pub fn delay_at(&self, t: ServerTime) -> Span {
        match &self.state {
            State::Joined(joined) => joined.schedule.delay_at(t),
            _ => Span::ZERO,
        }
    }

    /// The client's participant number, once welcomed.
    pub fn participant(&self) -> Option<ParticipantId> {
        match &self.state {
            State::Joined(joined) => Some(joined.participant),
            _ => None,
        }
    }

    /// Statistics of the connection.
    pub fn stats(&self, now: ClientTime) -> LinkStats {
        let compensation = self
            .clock
            .map()
            .map(|map| self.delay_at(map.to_server(now)));
        LinkStats {
            rtt: self.clock.rtt(),
            compensation,
            ..self.link.stats()
        }
    }

    fn note_received(&mut self, now: ClientTime) {
        self.last_received = now;
        if self.link_lost {
            self.link_lost = false;
            self.emit(ClientEvent::LinkRestored);
        }
    }

    fn emit(&mut self, event: ClientEvent) {
        if matches!(self.state, State::Closed) {
            return;
        }
        if self.events.len() == EVENTS_MAX {
            // Lossy news make room; a shell that never drains loses those first.
            let lossy = |e: &ClientEvent| {
                matches!(
                    e,
                    ClientEvent::Motion(_)
                        | ClientEvent::Corrections(_)
                        | ClientEvent::Displacements(_)
                )
            };
            if let Some(i) = self.events.iter().position(lossy) {
                self.events.remove(i);
            } else {
                let limit = EVENTS_MAX;
                let error = ProtocolError::TooLarge {
                    what: "event queue",
                    bytes: limit,
                    limit,
                };
                return self.close(CloseReason::Violation(error));
            }
        }
        self.events.push_back(event);
    }

    fn close(&mut self, reason: CloseReason) {
        if !matches!(self.state, State::Closed) {
            self.state = State::Closed;
            self.events.push_back(ClientEvent::Closed(reason));
        }
    }
}
