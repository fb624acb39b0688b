//! The server of a simulation: the room and its protocol sessions, with the CPU time of each part.
//!
//! As in the host program, there are two workers. The network worker decodes and encodes datagrams as soon
//! as they are available. The room worker handles events, solves and produces output. Time is virtual. With a
//! solver limit the room worker stays busy for the CPU time of its work, so a tick starts late after an
//! overrun. Without one its work takes no time, so a seed reproduces the simulation.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_client::realtime::worked;
use palpate_protocol::operation::CompensationSettings;
use palpate_protocol::session::{PeerDatagram, PeerEvent, Picture, ServerPeer};
use palpate_protocol::{Epoch, Grant, ModelHash, ModelInfo, ResumeToken, Role, ServerTime, Span};
use palpate_room::{LimitCounters, Output, PeerKey, RoomConfig, SimulatedRoom};
use palpate_tissue::Model;

use super::links::{Arrived, Links};
use crate::network::Direction;

pub(crate) const GRANT: Grant = Grant(*b"a rehearsal only");

/// Stride between the connection numbers of one seat.
const SEATS_MAX: u64 = 1000;

/// Shapes kept for comparison with delayed views: four seconds at 60 Hz.
const PICTURES_MAX: usize = 240;

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
    pub iterations: usize,
    pub residual: f64,
}

pub(crate) fn room_config(
    seats: usize,
    tick_hz: u32,
    compensation: CompensationSettings,
    start_when_tools: usize,
) -> RoomConfig {
    RoomConfig {
        epoch: Epoch(1),
        model: ModelInfo {
            hash: ModelHash(0),
            bytes: 0,
        },
        grants: vec![(Role::Trainee, GRANT), (Role::Spectator, GRANT)],
        seats: u16::try_from(seats).unwrap_or(u16::MAX),
        spectators: u16::try_from(seats).unwrap_or(u16::MAX),
        tick_hz,
        compensation,
        start_when_tools: u16::try_from(start_when_tools).unwrap_or(u16::MAX),
        // Predictable secrets are safe: the simulation has no attacker.
        fresh_token: |who| ResumeToken([who.0 as u8; 16]),
        fresh_grant: |id| Grant((u128::MAX - u128::from(id)).to_le_bytes()),
    }
}

pub(crate) struct Host {
    pub(super) room: SimulatedRoom,
    peers: BTreeMap<PeerKey, ServerPeer>,
    current: Vec<PeerKey>,
    /// Events that wait for the room worker.
    heard: Vec<(PeerKey, PeerEvent, ServerTime)>,
    /// Shapes of the last [`PICTURES_MAX`] ticks, kept if a thin spectator is subscribed.
    pub(super) pictures: BTreeMap<ServerTime, Arc<Picture>>,
    /// CPU time of the solver per tick; `None` for a server whose work takes no time.
    solver_limit: Option<Span>,
    /// Time at which the room worker becomes idle.
    free_at: ServerTime,
    round: Round,
    rounds: Vec<Round>,
}

impl Host {
    /// A server for the seats of the room, numbered from 0.
    pub(crate) fn new(model: Arc<Model>, config: RoomConfig, solver_limit: Option<Span>) -> Self {
        let now = ServerTime::ZERO;
        let current: Vec<PeerKey> = (0..config.seats).map(|k| PeerKey(k.into())).collect();
        Self {
            room: SimulatedRoom::new(model, config, now),
            peers: current.iter().map(|k| (*k, ServerPeer::new(now))).collect(),
            current,
            heard: Vec::new(),
            pictures: BTreeMap::new(),
            solver_limit,
            free_at: now,
            round: Round::default(),
            rounds: Vec::new(),
        }
    }

    /// Replaces the connection of a participant; the server is not notified of the old one's end.
    pub(super) fn renew(&mut self, seat: usize, now: ServerTime) {
        self.peers.remove(&self.current[seat]);
        let next = PeerKey(self.current[seat].0 + SEATS_MAX);
        self.current[seat] = next;
        self.peers.insert(next, ServerPeer::new(now));
    }

    /// Receives a packet from a seat. A server whose work takes no time forwards it at once.
    pub(super) fn handle(
        &mut self,
        seat: usize,
        arrived: &Arrived<Vec<u8>>,
        now: ServerTime,
        links: &mut Links<Vec<u8>>,
    ) {
        let began = worked();
        let key = self.current[seat];
        if let Some(peer) = self.peers.get_mut(&key) {
            match arrived {
                Arrived::Stream(segments) => peer.handle_stream(&segments.concat(), now),
                Arrived::Datagram(bytes) => peer.handle_datagram(bytes, now),
            }
            while let Some(event) = peer.poll_event() {
                self.heard.push((key, event, now));
            }
        }
        self.round.decode_us += (worked() - began).as_micros();
        if self.solver_limit.is_none() {
            self.turn(now, links);
        }
    }

    /// Handles timeouts, runs the room worker if it is idle, and sends pending output.
    pub(super) fn turn(&mut self, now: ServerTime, links: &mut Links<Vec<u8>>) {
        for (key, peer) in &mut self.peers {
            if peer.poll_timeout().is_some_and(|due| due <= now) {
                peer.handle_timeout(now);
            }
            while let Some(event) = peer.poll_event() {
                self.heard.push((*key, event, now));
            }
        }
        if now >= self.free_at {
            let did = self.room_turn(now);
            if self.solver_limit.is_some() {
                self.free_at = now + did;
            }
        }
        self.send(now, links);
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
            let limit = self.solver_limit;
            let mut stop = || limit.is_some_and(|limit| worked() - taken >= limit);
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
                    if let Some(peer) = self.peers.get_mut(&key) {
                        // A send error closes the session, which raises an event.
                        let _ = peer.send(&message, now);
                    }
                }
                Output::Datagram(key, datagram) => {
                    if let PeerDatagram::Picture(picture) = &datagram {
                        self.pictures.insert(picture.view_time, Arc::clone(picture));
                        if self.pictures.len() > PICTURES_MAX {
                            self.pictures.pop_first();
                        }
                    }
                    if let Some(peer) = self.peers.get_mut(&key) {
                        peer.send_datagram(&datagram, now);
                    }
                }
            }
        }
    }

    fn send(&mut self, now: ServerTime, links: &mut Links<Vec<u8>>) {
        let at_us = now.as_micros();
        let began = worked();
        let (mut streams, mut datagrams) = (Vec::new(), Vec::new());
        for (key, peer) in &mut self.peers {
            let seat = (key.0 % SEATS_MAX) as usize;
            streams.extend(std::iter::from_fn(|| peer.poll_stream()).map(|bytes| (seat, bytes)));
            let own = std::iter::from_fn(|| peer.poll_datagram(now));
            datagrams.extend(own.map(|bytes| (seat, bytes)));
        }
        self.round.fan_out_us += (worked() - began).as_micros();
        for (seat, bytes) in streams {
            links.send_stream(seat, Direction::Down, at_us, &bytes);
        }
        for (seat, bytes) in datagrams {
            links.send_datagram(seat, Direction::Down, at_us, bytes);
        }
    }

    /// Discards the costs so far.
    pub(crate) fn count_from_here(&mut self) {
        self.rounds.clear();
        self.round = Round::default();
    }

    pub(crate) fn into_rounds(self) -> Vec<Round> {
        self.rounds
    }

    pub(super) fn limits(&self) -> LimitCounters {
        *self.room.limits()
    }

    /// Bytes sent to a thin spectator so far, including protocol overhead.
    pub(super) fn bytes_to(&self, seat: usize) -> u64 {
        let peer = self.peers.get(&self.current[seat]);
        let stats = peer.and_then(ServerPeer::picture_stats);
        stats.map_or(0, |s| s.bytes)
    }
}
