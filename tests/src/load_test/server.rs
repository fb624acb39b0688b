//! The server in a load test: the room and its protocol sessions, with the CPU time of each part.
//!
//! As in the host program, there are two workers. The network worker decodes and encodes datagrams as soon
//! as they are available. The room worker handles events, solves and produces output. Time is virtual, but
//! the room worker stays busy for the CPU time of its work, so a tick starts late after an overrun.

use std::time::Duration;

use palpate_client::realtime::worked;
use palpate_protocol::session::{PeerDatagram, PeerEvent, ServerPeer};
use palpate_protocol::{ServerTime, Span};
use palpate_room::{Output, PeerKey, RoomConfig, SimulatedRoom};

use crate::network::Direction;
use crate::simulated_session::wires::{Arrived, Wires};

/// Cost of one server period, µs of CPU time on one thread.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Round {
    /// Decoding of input and its handling by the room.
    pub decode_us: i64,
    /// The room's tick: collecting the tools and solving the tissue's equilibrium.
    pub tick_us: i64,
    /// Distribution of updates to all participants, with encoding.
    pub fan_out_us: i64,
    /// Share of the room's thread in these costs.
    pub room_us: i64,
    /// Delay of the tick's start, µs of virtual time.
    pub late_us: i64,
    /// Iterations of the solver.
    pub iterations: usize,
    /// Relative residual after the solve.
    pub residual: f64,
}

/// The server.
pub(super) struct Server {
    room: SimulatedRoom,
    peers: Vec<ServerPeer>,
    heard: Vec<(PeerKey, PeerEvent, ServerTime)>,
    solver_limit: Duration,
    /// Time at which the room worker becomes idle.
    free_at: ServerTime,
    round: Round,
    pub(super) rounds: Vec<Round>,
}

impl Server {
    pub(super) fn new(room: SimulatedRoom, config: &RoomConfig, seats: usize) -> Self {
        let now = ServerTime::ZERO;
        let period = config.tick_period();
        let tick = Duration::from_micros(period.as_micros().unsigned_abs());
        Self {
            room,
            peers: (0..seats).map(|_| ServerPeer::new(now)).collect(),
            heard: Vec::new(),
            solver_limit: palpate_server::host::solver_limit(tick),
            free_at: now,
            round: Round::default(),
            rounds: Vec::new(),
        }
    }

    /// Receives a packet from a seat.
    pub(super) fn handle(&mut self, seat: usize, arrived: &Arrived, now: ServerTime) {
        let began = worked();
        let peer = &mut self.peers[seat];
        match arrived {
            Arrived::Stream(bytes) => peer.handle_stream(bytes, now),
            Arrived::Datagram(bytes) => peer.handle_datagram(bytes, now),
        }
        let key = PeerKey(seat as u64);
        while let Some(event) = peer.poll_event() {
            self.heard.push((key, event, now));
        }
        self.round.decode_us += (worked() - began).as_micros();
    }

    /// Handles timeouts, runs the room worker if it is idle, and sends pending output.
    pub(super) fn turn(&mut self, now: ServerTime, wires: &mut Wires) {
        for (seat, peer) in self.peers.iter_mut().enumerate() {
            if peer.poll_timeout().is_some_and(|due| due <= now) {
                peer.handle_timeout(now);
                while let Some(event) = peer.poll_event() {
                    self.heard.push((PeerKey(seat as u64), event, now));
                }
            }
        }
        if now >= self.free_at {
            let did = self.room_turn(now);
            self.free_at = now + did;
        }
        self.send(now, wires);
    }

    /// Runs the room worker once and returns its CPU time.
    fn room_turn(&mut self, now: ServerTime) -> Span {
        let began = worked();
        for (key, event, at) in std::mem::take(&mut self.heard) {
            self.room.handle_event(key, event, at);
        }
        let taken = worked();
        let late = now - self.room.next_tick();
        let mut ended = None;
        if self.room.poll_timeout() <= now {
            let limit = self.solver_limit.as_micros() as i64;
            let mut stop = || (worked() - taken).as_micros() >= limit;
            ended = self.room.handle_tick(now, &mut stop);
        }
        let ticked = worked();
        self.give_outputs(now);
        let given = worked();
        self.round.decode_us += (taken - began).as_micros();
        self.round.fan_out_us += (given - ticked).as_micros();
        self.round.room_us += (given - began).as_micros();
        if let Some(report) = ended {
            self.rounds.push(Round {
                tick_us: (ticked - taken).as_micros(),
                late_us: late.as_micros().max(0),
                iterations: report.iterations,
                residual: report.residual,
                ..self.round
            });
            self.round = Round::default();
        }
        given - began
    }

    fn give_outputs(&mut self, now: ServerTime) {
        while let Some(output) = self.room.poll_output() {
            match output {
                Output::Message(key, message) => {
                    if let Some(peer) = self.peers.get_mut(key.0 as usize) {
                        // A send error closes the session, which raises an event.
                        let _ = peer.send(&message, now);
                    }
                }
                Output::Datagram(key, datagram) => self.give_datagram(key, &datagram, now),
            }
        }
    }

    fn give_datagram(&mut self, key: PeerKey, datagram: &PeerDatagram, now: ServerTime) {
        if let Some(peer) = self.peers.get_mut(key.0 as usize) {
            peer.send_datagram(datagram, now);
        }
    }

    fn send(&mut self, now: ServerTime, wires: &mut Wires) {
        let at_us = now.as_micros().unsigned_abs();
        let mut made = Vec::new();
        let began = worked();
        for (seat, peer) in self.peers.iter_mut().enumerate() {
            while let Some(bytes) = peer.poll_stream() {
                made.push((seat, Arrived::Stream(bytes)));
            }
            while let Some(bytes) = peer.poll_datagram(now) {
                made.push((seat, Arrived::Datagram(bytes)));
            }
        }
        self.round.fan_out_us += (worked() - began).as_micros();
        for (seat, what) in made {
            match what {
                Arrived::Stream(bytes) => wires.send_stream(seat, Direction::Down, &bytes, at_us),
                Arrived::Datagram(bytes) => {
                    wires.send_datagram(seat, Direction::Down, bytes, at_us);
                }
            }
        }
    }

    /// Discards the measurements so far.
    pub(super) fn count_from_here(&mut self) {
        self.rounds.clear();
        self.round = Round::default();
    }
}
