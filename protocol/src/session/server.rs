//! The server's end of one client's session.

mod incoming_requests;

use std::collections::VecDeque;

use crate::codec::{self, FrameDecoder};
use crate::datagram::TRACKS_MAX;
use crate::datagram::{Body, Probe, Reply};
use crate::handshake::{Hello, PROTOCOL_VERSION, Preamble, RefusalReason, Refused};
use crate::lateness::LONG_STALL;
use crate::name;
use crate::request::{ClientMessage, ServerMessage};
use crate::session::copies::{IncomingCopies, OutgoingCopies};
use crate::session::outbox::Outbox;
use crate::session::picture::{PictureStats, PictureStream};
use crate::session::preamble::{self, PreambleReader};
use crate::session::round_trip::RoundTrip;
use crate::session::{
    CloseReason, EVENTS_MAX, HANDSHAKE_TIMEOUT, HEARTBEAT, Link, LinkStats, MessageCopy,
    MotionRound, PEER_SILENCE, PeerDatagram, PeerEvent, PeerMessage, PeerMotion,
    STREAM_BACKLOG_MAX_BYTES, STREAM_STALL_MAX,
};
use crate::{OperationId, ParticipantId, ProtocolError, ServerTime, Span, TokenBucket, ToolTrack};

/// Rate of accepted requests. Further ones are refused with
/// [`RequestRefusal::TooMany`](crate::request::RequestRefusal::TooMany).
pub const REQUESTS_PER_SECOND_MAX: u32 = 50;

/// Burst of accepted requests: a stall brings the parts of a stroke of [`PEER_SILENCE`](super::PEER_SILENCE) at once.
pub const REQUESTS_BURST_MAX: u32 = 128;

/// Burst of refused requests; their rate is [`REQUESTS_PER_SECOND_MAX`], too. A client that sends more
/// ignores its refusals, and its session is closed. A client that repeats all requests of a broken
/// connection stays below it.
pub const REFUSALS_BURST_MAX: u32 = 200;

/// The largest time of a sample ahead of now; a later one makes the datagram noise. It is the clock error of a
/// path whose directions differ by 300 ms. Receivers ignore honest motion that is older than a false time.
pub const FUTURE_MAX: Span = Span::from_millis(150);

/// Older samples are noise, too: no site displays them, and receivers must distinguish them from new
/// ones.
const PAST_MAX: Span = Span::from_millis(2000);

enum State {
    Preamble(PreambleReader),
    Hello,
    /// The room has the hello and has not answered.
    AwaitsRoom,
    Joined {
        participant: ParticipantId,
        next_operation: OperationId,
        /// The end of the log of the welcome.
        log_end: u64,
    },
    Closed,
}

#[cfg(test)]
impl ServerPeer {
    /// The states, as named in STATES.md.
    pub(super) const STATES: [&str; 5] = ["Preamble", "Hello", "AwaitsRoom", "Joined", "Closed"];

    pub(super) fn state_name(&self) -> &'static str {
        match self.state {
            State::Preamble(_) => Self::STATES[0],
            State::Hello => Self::STATES[1],
            State::AwaitsRoom => Self::STATES[2],
            State::Joined { .. } => Self::STATES[3],
            State::Closed => Self::STATES[4],
        }
    }
}

/// The server's end of one client's session: see [`crate::session`] for the calling order.
///
/// Answer [`PeerEvent::Hello`] with [`PeerMessage::Welcome`] or [`PeerMessage::Refused`]; after the
/// welcome send the snapshot in pieces and every operation of the log from its `first_operation` and then each new one.
pub struct ServerPeer {
    state: State,
    decoder: FrameDecoder<ClientMessage>,
    outbox: Outbox,
    copies: OutgoingCopies,
    incoming: IncomingCopies<ClientMessage>,
    link: Link,
    /// The picture stream of a thin subscriber, from its first picture on.
    picture: Option<Box<PictureStream>>,
    events: VecDeque<PeerEvent>,
    started: ServerTime,
    last_received: ServerTime,
    heartbeat_due: ServerTime,
    /// The rate of accepted requests, and that of refused ones.
    accepted: TokenBucket,
    refused: TokenBucket,
    round_trip: RoundTrip,
}

impl ServerPeer {
    /// Waits for a client's preamble and hello.
    pub fn new(now: ServerTime) -> Self {
        let rate = f64::from(REQUESTS_PER_SECOND_MAX);
        Self {
            state: State::Preamble(PreambleReader::default()),
            decoder: FrameDecoder::new(codec::HELLO_MAX_BYTES),
            outbox: Outbox::default(),
            copies: OutgoingCopies::default(),
            incoming: IncomingCopies::default(),
            link: Link::default(),
            picture: None,
            events: VecDeque::new(),
            started: now,
            last_received: now,
            heartbeat_due: now,
            accepted: TokenBucket::new(rate, REQUESTS_BURST_MAX.into(), now - ServerTime::ZERO),
            refused: TokenBucket::new(rate, REFUSALS_BURST_MAX.into(), now - ServerTime::ZERO),
            round_trip: RoundTrip::default(),
        }
    }

    /// Bytes of the operations stream, in any pieces.
    pub fn handle_stream(&mut self, bytes: &[u8], now: ServerTime) {
        if let Err(error) = self.read_stream(bytes, now) {
            self.violation(error);
        }
        self.outbox.note(now);
    }

    fn read_stream(&mut self, mut bytes: &[u8], now: ServerTime) -> Result<(), ProtocolError> {
        if let State::Preamble(reader) = &mut self.state {
            let Some(opening) = reader.push(bytes)? else {
                return Ok(());
            };
            bytes = &bytes[bytes.len() - opening.left_over..];
            let theirs = opening.preamble.version;
            if theirs != PROTOCOL_VERSION {
                let sentence = format!(
                    "this server speaks protocol version {PROTOCOL_VERSION}, the client speaks version {theirs}; use the release that the server runs"
                );
                self.outbox.push_bytes(preamble::refusing(&sentence))?;
                self.close(CloseReason::Violation(ProtocolError::Version { theirs }));
                return Ok(());
            }
            self.outbox.push_bytes(Preamble::OURS.to_bytes().to_vec())?;
            self.state = State::Hello;
        }
        self.last_received = now;
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
    fn handle_early(&mut self, now: ServerTime) -> Result<(), ProtocolError> {
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
        now: ServerTime,
    ) -> Result<(), ProtocolError> {
        match codec::decode_body(&message) {
            Ok(message) => self.incoming.push(number, message),
            Err(_) => self.link.count_malformed(),
        }
        self.handle_early(now)
    }

    fn handle_message(
        &mut self,
        message: ClientMessage,
        now: ServerTime,
    ) -> Result<(), ProtocolError> {
        match (&self.state, message) {
            (State::Hello, ClientMessage::Hello(hello)) => match name::normalise(&hello.name) {
                Ok(name) => {
                    self.state = State::AwaitsRoom;
                    self.emit(PeerEvent::Hello(Hello { name, ..hello }));
                    Ok(())
                }
                Err(error) => {
                    let reason = error.to_string();
                    self.refuse(Refused::because(RefusalReason::BadName { reason }))
                }
            },
            (State::Joined { .. }, ClientMessage::Request(request)) => {
                self.handle_request(request, now)
            }
            (_, ClientMessage::Hello(_)) => Err(ProtocolError::OutOfOrder {
                what: "hello",
                state: "another hello was already there",
            }),
            (_, ClientMessage::Request(_)) => Err(ProtocolError::OutOfOrder {
                what: "request",
                state: "the hello is not answered",
            }),
        }
    }

    /// One datagram. Noise is counted and otherwise ignored.
    pub fn handle_datagram(&mut self, bytes: &[u8], now: ServerTime) {
        self.handle_waiting_datagram(bytes, Span::ZERO, now);
    }

    /// The same for a datagram that may have waited for `stall`, because this machine stalled
    /// ([`StallDetector`](crate::lateness::StallDetector)).
    pub fn handle_waiting_datagram(&mut self, bytes: &[u8], stall: Span, now: ServerTime) {
        let Some(datagram) = self.link.accept(bytes) else {
            return;
        };
        self.link.count_stall(stall);
        let State::Joined { participant, .. } = self.state else {
            return;
        };
        self.last_received = now;
        // The round trip would include this machine's stall.
        if stall <= LONG_STALL {
            self.round_trip.note(self.link.round_trip(now), now);
        }
        if let Some(picture) = &mut self.picture {
            picture.acknowledge(self.link.fresh(), now);
        }
        match datagram.body {
            Body::Motion(tracks) => self.handle_motion(tracks, participant, stall, now),
            // The round trip would include this machine's stall; the next probe follows soon.
            Body::Probe(_) if stall > LONG_STALL => {}
            Body::Probe(probe) => self.handle_probe(probe, now),
            Body::Delays(list) => match list.as_slice() {
                // A heartbeat with an acknowledgement.
                [] => {}
                [(who, report)] if *who == participant => self.emit(PeerEvent::Delay(*report)),
                _ => self.link.count_misdirected(),
            },
            Body::Copy(copy) => {
                if let Err(error) = self.handle_copy(copy, now) {
                    self.violation(error);
                }
            }
            Body::Corrections(_) | Body::Displacements(_) | Body::Reply(_) => {
                self.link.count_misdirected();
            }
        }
    }

    fn handle_motion(
        &mut self,
        tracks: Vec<ToolTrack>,
        participant: ParticipantId,
        stall: Span,
        now: ServerTime,
    ) {
        for track in tracks {
            let oldest = track.samples.first().map_or(now, |s| s.time);
            let newest = track.samples.last().map_or(now, |s| s.time);
            if track.participant != participant || newest > now + FUTURE_MAX {
                self.link.count_misdirected();
            } else if oldest < now - PAST_MAX {
                self.link.count_old();
            } else {
                self.emit(PeerEvent::Motion(PeerMotion {
                    samples: track.samples,
                    arrived: now,
                    late: track.late,
                    stall,
                    round_trip: self.round_trip.longest(),
                }));
            }
        }
    }

    fn handle_probe(&mut self, probe: Probe, now: ServerTime) {
        let reply = Reply {
            id: probe.id,
            client_sent: probe.client_sent,
            server_received: now,
            server_sent: now,
        };
        self.link.enqueue(Body::Reply(reply), now);
    }

    /// Call at the time of [`poll_timeout`](Self::poll_timeout); an earlier call does no harm.
    pub fn handle_timeout(&mut self, now: ServerTime) {
        match self.state {
            State::Closed => {}
            State::Preamble(_) | State::Hello | State::AwaitsRoom => {
                if now - self.started >= HANDSHAKE_TIMEOUT {
                    self.close(CloseReason::HandshakeTimeout);
                }
            }
            State::Joined { .. } => {
                while let Some(copy) = self.copies.poll(now - ServerTime::ZERO) {
                    self.link.enqueue_copy(copy, now);
                }
                if now - self.last_received >= PEER_SILENCE {
                    self.close(CloseReason::Silent(PEER_SILENCE));
                } else if self.outbox.is_stalled(now) {
                    let waited = STREAM_STALL_MAX;
                    self.violation(ProtocolError::Stalled { waited });
                } else if now >= self.heartbeat_due {
                    self.heartbeat_due = now + HEARTBEAT;
                    self.link.enqueue(Body::Delays(Vec::new()), now);
                }
            }
        }
    }

    /// The connection of the session is lost.
    pub fn handle_disconnect(&mut self, why: String) {
        self.close(CloseReason::ConnectionLost(why));
    }

    /// The participant left for good, with the close frame of the connection only.
    pub fn handle_goodbye(&mut self) {
        self.close(CloseReason::Left);
    }

    /// The room's messages exceed the queue of this peer.
    pub fn handle_overflow(&mut self) {
        let limit = STREAM_BACKLOG_MAX_BYTES;
        self.violation(ProtocolError::Backlog {
            bytes: limit,
            limit,
        });
    }

    /// Sends a reliable message to the client. An error closes the session; the event follows.
    pub fn send(&mut self, message: &PeerMessage, now: ServerTime) -> Result<(), ProtocolError> {
        if matches!(self.state, State::Closed) {
            return Ok(());
        }
        let result = self.write(message, now);
        self.outbox.note(now);
        if let Err(error) = &result {
            self.close(CloseReason::Violation(error.clone()));
        }
        result
    }

    fn write(&mut self, message: &PeerMessage, now: ServerTime) -> Result<(), ProtocolError> {
        let not_joined = |what| {
            Err(ProtocolError::OutOfOrder {
                what,
                state: "no participant has joined",
            })
        };
        match (message, &mut self.state) {
            (PeerMessage::Welcome(welcome), State::AwaitsRoom) => {
                self.push(&ServerMessage::Welcome(welcome.clone()), false, now)?;
                self.link.open(welcome.epoch, welcome.participant);
                self.decoder.set_limit(codec::FRAME_MAX_BYTES);
                self.state = State::Joined {
                    participant: welcome.participant,
                    next_operation: welcome.first_operation,
                    log_end: welcome.operations_so_far,
                };
                self.last_received = now;
                Ok(())
            }
            (PeerMessage::Welcome(_), _) => not_joined("welcome without a hello"),
            (PeerMessage::Refused(refused), _) => self.refuse(refused.clone()),
            (
                PeerMessage::Operation(operation),
                State::Joined {
                    next_operation,
                    log_end,
                    ..
                },
            ) => {
                // A gap stands for operations that no longer matter.
                if operation.id < *next_operation {
                    return Err(ProtocolError::OperationOrder {
                        expected: next_operation.0,
                        found: operation.id.0,
                    });
                }
                *next_operation = operation.id.next();
                // The log of the welcome needs no copies.
                let is_live = operation.id.0 >= *log_end;
                let message = ServerMessage::Operation(operation.as_ref().clone());
                self.push(&message, is_live, now)
            }
            (PeerMessage::Snapshot(piece), State::Joined { .. }) => {
                self.push(&ServerMessage::Snapshot(piece.to_vec()), false, now)
            }
            (PeerMessage::RequestRefused(refused), State::Joined { .. }) => {
                self.push(&ServerMessage::RequestRefused(refused.clone()), true, now)
            }
            (PeerMessage::Invitation(invitation), State::Joined { .. }) => {
                self.push(&ServerMessage::Invitation(*invitation), true, now)
            }
            (PeerMessage::Invitation(_), _) => not_joined("invitation"),
            (PeerMessage::Snapshot(_), _) => not_joined("snapshot"),
            (PeerMessage::Operation(_), _) => not_joined("operation"),
            (PeerMessage::RequestRefused(_), _) => not_joined("refusal of a request"),
            (PeerMessage::Goodbye(sentence), _) => {
                self.outbox.push(&ServerMessage::Goodbye {
                    sentence: sentence.clone(),
                })?;
                self.close(CloseReason::Goodbye(sentence.clone()));
                Ok(())
            }
        }
    }

    /// Sends a message on the stream, and later as a copy.
    fn push(
        &mut self,
        message: &ServerMessage,
        has_copy: bool,
        now: ServerTime,
    ) -> Result<(), ProtocolError> {
        let frame = codec::encode_frame(message)?;
        let loss = has_copy.then(|| self.link.loss_out());
        self.copies.push(&frame[codec::PREFIX_BYTES..], loss);
        self.copies.note(now - ServerTime::ZERO);
        self.outbox.push_bytes(frame)
    }

    fn refuse(&mut self, refused: Refused) -> Result<(), ProtocolError> {
        self.outbox.push(&ServerMessage::Refused(refused.clone()))?;
        self.close(CloseReason::Refused(refused));
        Ok(())
    }

    /// Sends an unreliable message; before the welcome it is dropped.
    pub fn send_datagram(&mut self, datagram: &PeerDatagram, now: ServerTime) {
        let State::Joined { participant, .. } = self.state else {
            return;
        };
        match datagram {
            PeerDatagram::Motion(round) => self.enqueue_motion(round, participant),
            PeerDatagram::Corrections(c) => {
                let body = Body::Corrections(c.as_ref().clone());
                self.link.enqueue(body, now);
            }
            PeerDatagram::Displacements(d) => {
                let body = Body::Displacements(d.as_ref().clone());
                self.link.enqueue(body, now);
            }
            PeerDatagram::Picture(picture) => {
                self.picture.get_or_insert_default().show(picture);
                // The heartbeat is due all the same: a picture at rest sends nothing.
                return;
            }
            PeerDatagram::Delays(list) => {
                for piece in list.chunks(crate::datagram::DELAYS_MAX) {
                    self.link.enqueue(Body::Delays(piece.to_vec()), now);
                }
            }
        }
        self.heartbeat_due = now + HEARTBEAT;
    }

    /// Puts the tools of the other participants into datagrams; one that gets too long is halved when it
    /// is encoded.
    fn enqueue_motion(&mut self, round: &MotionRound, own: ParticipantId) {
        let since = round.released;
        let others = round
            .tracks
            .iter()
            .filter(|t| t.participant != own && !t.samples.is_empty());
        let mut batch = Vec::new();
        for track in others {
            if batch.len() == TRACKS_MAX {
                let full = std::mem::take(&mut batch);
                self.link.enqueue(Body::Motion(full), since);
            }
            batch.push(track.clone());
        }
        if !batch.is_empty() {
            self.link.enqueue(Body::Motion(batch), since);
        }
    }

    /// Bytes for the operations stream, in order.
    pub fn poll_stream(&mut self) -> Option<Vec<u8>> {
        let bytes = self.outbox.pop()?;
        if let Some(picture) = &mut self.picture {
            picture.charge(bytes.len());
        }
        Some(bytes)
    }

    /// The next datagram.
    pub fn poll_datagram(&mut self, now: ServerTime) -> Option<Vec<u8>> {
        match self.state {
            State::Joined { .. } => {
                let Some(picture) = &mut self.picture else {
                    return self.link.pop(now);
                };
                let other = self.link.pop(now);
                let bytes = other.or_else(|| picture.next(&mut self.link, now))?;
                picture.charge(bytes.len());
                Some(bytes)
            }
            _ => None,
        }
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<PeerEvent> {
        self.events.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due; `None` once closed.
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        match self.state {
            State::Closed => None,
            State::Preamble(_) | State::Hello | State::AwaitsRoom => {
                Some(self.started + HANDSHAKE_TIMEOUT)
            }
            State::Joined { .. } => {
                let due = self.heartbeat_due.min(self.last_received + PEER_SILENCE);
                let copy = self.copies.due().map(|due| ServerTime::ZERO + due);
                let others = [self.outbox.due(), copy].into_iter().flatten();
                Some(others.fold(due, ServerTime::min))
            }
        }
    }

    /// Whether the shell may [`send`](Self::send) a further message: encoded messages wait for the stream
    /// up to a high-water mark. Datagrams need no room.
    pub fn has_room(&self) -> bool {
        self.outbox.has_room()
    }

    /// Whether the room has welcomed the client.
    pub fn is_joined(&self) -> bool {
        matches!(self.state, State::Joined { .. })
    }

    /// Whether the session is over. The shell still sends the rest that
    /// [`poll_stream`](Self::poll_stream) returns.
    pub fn is_closed(&self) -> bool {
        matches!(self.state, State::Closed)
    }

    /// Statistics of the connection.
    pub fn stats(&self) -> LinkStats {
        self.link.stats()
    }

    /// The statistics of a thin subscriber's picture stream; `None` for any other subscriber.
    pub fn picture_stats(&self) -> Option<PictureStats> {
        self.picture.as_ref().map(|p| p.stats())
    }

    fn emit(&mut self, event: PeerEvent) {
        if matches!(self.state, State::Closed) {
            return;
        }
        if self.events.len() == EVENTS_MAX {
            // The oldest motion is dropped first: a stalled room is not the fault of its peers.
            let lossy = |e: &PeerEvent| matches!(e, PeerEvent::Motion(_) | PeerEvent::Delay(_));
            if let Some(i) = self.events.iter().position(lossy) {
                self.events.remove(i);
                self.events.push_back(event);
                return;
            }
            let limit = EVENTS_MAX;
            let error = ProtocolError::TooLarge {
                what: "event queue",
                bytes: limit,
                limit,
            };
            return self.violation(error);
        }
        self.events.push_back(event);
    }

    fn violation(&mut self, error: ProtocolError) {
        if !matches!(self.state, State::Closed | State::Preamble(_)) {
            let sentence = error.to_string();
            // The session ends in any case; a failed farewell needs no second error.
            let _ = self.outbox.push(&ServerMessage::Goodbye { sentence });
        }
        self.close(CloseReason::Violation(error));
    }

    fn close(&mut self, reason: CloseReason) {
        if !matches!(self.state, State::Closed) {
            self.state = State::Closed;
            self.events.push_back(PeerEvent::Closed(reason));
        }
    }
}
