//! The server in a simulated session: the room and its protocol sessions, without sockets or wall clock.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_protocol::session::{PeerDatagram, Picture, ServerPeer};
use palpate_protocol::{ServerTime, TopologyHash};
use palpate_room::{Output, PeerKey, RoomConfig, SimulatedRoom};
use palpate_tissue::Model;

use super::wires::Wires;
use crate::network::Direction;

/// Stride between the connection numbers of one seat.
const SEATS_MAX: u64 = 1000;

/// The server.
pub(super) struct Host {
    room: SimulatedRoom,
    peers: BTreeMap<PeerKey, ServerPeer>,
    /// The current connection of each seat.
    current: Vec<PeerKey>,
    /// Shapes of the last [`PICTURES_MAX`] ticks, kept if a thin spectator is subscribed.
    pictures: BTreeMap<ServerTime, Arc<Picture>>,
}

/// Shapes kept for comparison with delayed views: four seconds at 60 Hz.
const PICTURES_MAX: usize = 240;

impl Host {
    /// A server for `seats` participants, numbered from 0.
    pub(super) fn new(model: Arc<Model>, config: RoomConfig, seats: usize) -> Self {
        let now = ServerTime::ZERO;
        let peers = (0..seats).map(|seat| (key(seat), ServerPeer::new(now)));
        Self {
            room: SimulatedRoom::new(model, config, now),
            peers: peers.collect(),
            current: (0..seats).map(key).collect(),
            pictures: BTreeMap::new(),
        }
    }

    /// Replaces the connection of a participant; the server is not notified of the old one's end.
    pub(super) fn renew(&mut self, seat: usize, now: ServerTime) {
        self.peers.remove(&self.current[seat]);
        let next = PeerKey(self.current[seat].0 + SEATS_MAX);
        self.current[seat] = next;
        self.peers.insert(next, ServerPeer::new(now));
    }

    /// Receives bytes of a participant's operations stream.
    pub(super) fn handle_stream(&mut self, seat: usize, bytes: &[u8], now: ServerTime) {
        if let Some(peer) = self.peers.get_mut(&self.current[seat]) {
            peer.handle_stream(bytes, now);
        }
    }

    /// Receives a participant's datagram.
    pub(super) fn handle_datagram(&mut self, seat: usize, bytes: &[u8], now: ServerTime) {
        if let Some(peer) = self.peers.get_mut(&self.current[seat]) {
            peer.handle_datagram(bytes, now);
        }
    }

    /// Runs the tick if it is due and sends all pending output.
    pub(super) fn turn(&mut self, now: ServerTime, wires: &mut Wires) {
        for peer in self.peers.values_mut() {
            if peer.poll_timeout().is_some_and(|due| due <= now) {
                peer.handle_timeout(now);
            }
        }
        self.take_events(now);
        if self.room.poll_timeout() <= now {
            // Iterations limit the tick instead of time, so a seed reproduces it.
            self.room.handle_tick(now, &mut || false);
        }
        self.give_outputs(now);
        let at_us = now.as_micros().unsigned_abs();
        for (key, peer) in &mut self.peers {
            let seat = (key.0 % SEATS_MAX) as usize;
            while let Some(bytes) = peer.poll_stream() {
                wires.send_stream(seat, Direction::Down, &bytes, at_us);
            }
            while let Some(bytes) = peer.poll_datagram(now) {
                wires.send_datagram(seat, Direction::Down, bytes, at_us);
            }
        }
    }

    fn take_events(&mut self, now: ServerTime) {
        for (key, peer) in &mut self.peers {
            while let Some(event) = peer.poll_event() {
                self.room.handle_event(*key, event, now);
            }
        }
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

    /// Number of demotions to spectator because of lateness.
    pub(super) fn demotions(&self) -> u64 {
        self.room.demotion_count()
    }

    /// The server's shapes of the last ticks.
    pub(super) fn pictures(&self) -> &BTreeMap<ServerTime, Arc<Picture>> {
        &self.pictures
    }

    /// Bytes sent to a thin spectator so far, including protocol overhead.
    pub(super) fn bytes_to(&self, seat: usize) -> u64 {
        let stats = self
            .peers
            .get(&self.current[seat])
            .and_then(ServerPeer::picture_stats);
        stats.map_or(0, |s| s.bytes)
    }

    /// Version and hash of the authoritative topology.
    pub(super) fn topology(&self) -> (u32, TopologyHash) {
        self.room.topology()
    }
}

fn key(seat: usize) -> PeerKey {
    PeerKey(seat as u64)
}
