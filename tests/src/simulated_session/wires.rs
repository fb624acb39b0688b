//! Emulated network links of all sessions. The operations stream is made reliable by retransmission.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use serde::Serialize;

use crate::network::{Direction, Path, Profile};

/// Bit of a datagram's first byte that announces an acknowledgement, and the acknowledgement's size in
/// bytes.
const ACKNOWLEDGES: u8 = 0x08;
const ACKNOWLEDGEMENT_BYTES: u16 = 6;

/// Largest segment of a stream, bytes.
const SEGMENT_BYTES: usize = 1100;

/// Retransmission timeout of a lost segment, µs: that of a transport with a round trip of 250 ms. The
/// receiver buffers later segments until then.
const AGAIN_US: u64 = 300_000;

/// Maximum number of logged packets: one hour of one participant.
const SENT_MAX: usize = 4_000_000;

/// Purpose of a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// The operations stream.
    Operations,
    /// Tool motion.
    Motion,
    /// Node positions.
    Corrections,
    /// Clock probes and replies.
    Clock,
    /// Delay reports and heartbeats.
    Delays,
}

impl Part {
    /// All purposes.
    pub const ALL: [Self; 5] = [
        Self::Operations,
        Self::Motion,
        Self::Corrections,
        Self::Clock,
        Self::Delays,
    ];

    /// The purpose of a datagram, from the kind in its first byte.
    fn of_datagram(bytes: &[u8]) -> Self {
        match bytes.first().map_or(0, |b| b & 0x07) {
            1 => Self::Motion,
            3 | 4 => Self::Clock,
            5 => Self::Delays,
            _ => Self::Corrections,
        }
    }
}

/// A packet that was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// Send time, µs of true time.
    pub at_us: u64,
    /// Seat of the session.
    pub seat: usize,
    /// Uplink or downlink.
    pub direction: Direction,
    /// Purpose.
    pub part: Part,
    /// Bytes of the acknowledgement it carries.
    pub acknowledgement: u16,
    /// Total size in bytes, without QUIC overhead.
    pub bytes: u16,
}

/// Content of an arrival.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Arrived {
    /// Bytes of the operations stream, in order.
    Stream(Vec<u8>),
    /// A datagram.
    Datagram(Vec<u8>),
}

/// A packet in flight.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Packet {
    Datagram(Vec<u8>),
    /// Segment with its index in the stream.
    Segment(u64, Vec<u8>),
    /// A lost segment that is due for retransmission.
    Again(u64, Vec<u8>),
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct OnTheWay {
    at_us: u64,
    /// Send order; it decides between simultaneous arrivals.
    order: u64,
    seat: usize,
    direction: Direction,
    packet: Packet,
}

/// One direction of one session.
#[derive(Debug)]
struct Way {
    path: Path,
    next_out: u64,
    next_in: u64,
    early: BTreeMap<u64, Vec<u8>>,
    bytes: u64,
}

/// The links of all sessions.
#[derive(Debug)]
pub(crate) struct Wires {
    /// Uplink and downlink of each seat.
    ways: Vec<[Way; 2]>,
    queue: BinaryHeap<Reverse<OnTheWay>>,
    order: u64,
    sent: Vec<Sent>,
}

impl Wires {
    /// One pair of links per network profile.
    pub(crate) fn new(profiles: &[&Profile], seed: u64) -> Self {
        let way = |seat: usize, direction| Way {
            path: Path::new(profiles[seat], seed, seat as u64, direction),
            next_out: 0,
            next_in: 0,
            early: BTreeMap::new(),
            bytes: 0,
        };
        let both = |seat| [way(seat, Direction::Up), way(seat, Direction::Down)];
        Self {
            ways: (0..profiles.len()).map(both).collect(),
            queue: BinaryHeap::new(),
            order: 0,
            sent: Vec::new(),
        }
    }

    /// Replaces the connection of a seat. Packets in flight are dropped and streams restart. The round trip
    /// of the connection setup is not simulated.
    pub(super) fn renew(&mut self, seat: usize) {
        self.queue.retain(|Reverse(p)| p.seat != seat);
        for way in &mut self.ways[seat] {
            (way.next_out, way.next_in) = (0, 0);
            way.early.clear();
        }
    }

    fn way(&mut self, seat: usize, direction: Direction) -> &mut Way {
        &mut self.ways[seat][usize::from(direction == Direction::Down)]
    }

    /// Sends a datagram, which may be lost.
    pub(crate) fn send_datagram(
        &mut self,
        seat: usize,
        direction: Direction,
        bytes: Vec<u8>,
        at_us: u64,
    ) {
        self.send(seat, direction, Packet::Datagram(bytes), at_us);
    }

    /// Sends bytes of the operations stream.
    pub(crate) fn send_stream(
        &mut self,
        seat: usize,
        direction: Direction,
        bytes: &[u8],
        at_us: u64,
    ) {
        for piece in bytes.chunks(SEGMENT_BYTES) {
            let way = self.way(seat, direction);
            let n = way.next_out;
            way.next_out += 1;
            self.send(seat, direction, Packet::Segment(n, piece.to_vec()), at_us);
        }
    }

    fn send(&mut self, seat: usize, direction: Direction, packet: Packet, at_us: u64) {
        let len = match &packet {
            Packet::Datagram(bytes) | Packet::Segment(_, bytes) | Packet::Again(_, bytes) => {
                bytes.len()
            }
        };
        self.remember(seat, direction, &packet, len, at_us);
        let way = self.way(seat, direction);
        way.bytes += len as u64;
        let mut arrived = false;
        // Authentication rejects a damaged packet, so it counts as lost.
        for arrival in way
            .path
            .send(at_us, len)
            .into_iter()
            .filter(|a| a.corrupted.is_none())
        {
            arrived = true;
            self.put(arrival.at_us, seat, direction, packet.clone());
        }
        if let Packet::Segment(n, bytes) = packet
            && !arrived
        {
            self.put(at_us + AGAIN_US, seat, direction, Packet::Again(n, bytes));
        }
    }

    fn remember(
        &mut self,
        seat: usize,
        direction: Direction,
        packet: &Packet,
        len: usize,
        at_us: u64,
    ) {
        let (part, acknowledgement) = match packet {
            Packet::Datagram(bytes) => {
                let has_one = bytes.first().is_some_and(|b| b & ACKNOWLEDGES != 0);
                let bytes_of_it = if has_one { ACKNOWLEDGEMENT_BYTES } else { 0 };
                (Part::of_datagram(bytes), bytes_of_it)
            }
            Packet::Segment(..) | Packet::Again(..) => (Part::Operations, 0),
        };
        if self.sent.len() < SENT_MAX {
            self.sent.push(Sent {
                at_us,
                seat,
                direction,
                part,
                acknowledgement,
                bytes: u16::try_from(len).unwrap_or(u16::MAX),
            });
        }
    }

    fn put(&mut self, at_us: u64, seat: usize, direction: Direction, packet: Packet) {
        self.order += 1;
        self.queue.push(Reverse(OnTheWay {
            at_us,
            order: self.order,
            seat,
            direction,
            packet,
        }));
    }

    /// The next arrival by `until_us`: time, seat, direction and content.
    pub(crate) fn pop_due(&mut self, until_us: u64) -> Option<(u64, usize, Direction, Arrived)> {
        while self
            .queue
            .peek()
            .is_some_and(|Reverse(p)| p.at_us <= until_us)
        {
            let Reverse(p) = self.queue.pop()?;
            let arrived = match p.packet {
                Packet::Datagram(bytes) => Arrived::Datagram(bytes),
                Packet::Again(n, bytes) => {
                    self.send(p.seat, p.direction, Packet::Segment(n, bytes), p.at_us);
                    continue;
                }
                Packet::Segment(n, bytes) => match self.way(p.seat, p.direction).take(n, bytes) {
                    Some(whole) => Arrived::Stream(whole),
                    None => continue,
                },
            };
            return Some((p.at_us, p.seat, p.direction, arrived));
        }
        None
    }

    /// Starts counting bytes and logging packets.
    pub(crate) fn count_from_here(&mut self) {
        for way in self.ways.iter_mut().flatten() {
            way.bytes = 0;
        }
        self.sent.clear();
    }

    /// Takes the packets sent since counting started, in order.
    pub(crate) fn take_sent(&mut self) -> Vec<Sent> {
        std::mem::take(&mut self.sent)
    }

    /// Bytes of the first `seats` participants in a direction, including retransmissions.
    pub(crate) fn counted(&self, direction: Direction, seats: usize) -> u64 {
        let of = |ways: &[Way; 2]| ways[usize::from(direction == Direction::Down)].bytes;
        self.ways.iter().take(seats).map(of).sum()
    }
}

impl Way {
    /// Accepts a segment and returns the bytes that are now complete in order.
    fn take(&mut self, n: u64, bytes: Vec<u8>) -> Option<Vec<u8>> {
        if n >= self.next_in {
            self.early.insert(n, bytes);
        }
        let mut whole = Vec::new();
        while let Some(next) = self.early.remove(&self.next_in) {
            self.next_in += 1;
            whole.extend(next);
        }
        (!whole.is_empty()).then_some(whole)
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::datagram::Body;
    use palpate_protocol::examples;

    use super::*;

    #[test]
    fn datagram_purpose_matches_protocol_encoding() {
        let bytes = examples::datagram_bytes().unwrap();
        for (example, bytes) in examples::datagrams().into_iter().zip(bytes) {
            let (header, body) = (example.message.header, example.message.body);
            let part = match body {
                Body::Motion(_) => Part::Motion,
                Body::Corrections(_) | Body::Displacements(_) => Part::Corrections,
                Body::Probe(_) | Body::Reply(_) => Part::Clock,
                Body::Delays(_) => Part::Delays,
            };
            assert_eq!(Part::of_datagram(&bytes.message), part, "{}", example.name);
            let acknowledges = bytes.message[0] & ACKNOWLEDGES != 0;
            assert_eq!(acknowledges, header.acknowledged.is_some());
        }
    }

    #[test]
    fn stream_is_complete_and_ordered_despite_loss_and_reordering() {
        let lossy = Profile::named("lossy").unwrap();
        let mut wires = Wires::new(&[&lossy; 2], 3);
        let sent: Vec<u8> = (0..40_000_u32).map(|i| (i % 251) as u8).collect();
        for (i, piece) in sent.chunks(97).enumerate() {
            let at_us = i as u64 * 1000;
            wires.send_stream(1, Direction::Up, piece, at_us);
            wires.send_datagram(1, Direction::Up, vec![1], at_us);
        }
        let (mut back, mut datagrams, mut last) = (Vec::new(), 0, 0);
        while let Some((at_us, seat, direction, arrived)) = wires.pop_due(u64::MAX) {
            assert!(at_us >= last && seat == 1 && direction == Direction::Up);
            last = at_us;
            match arrived {
                Arrived::Stream(bytes) => back.extend(bytes),
                Arrived::Datagram(_) => datagrams += 1,
            }
        }
        assert_eq!(back, sent);
        assert!((280..400).contains(&datagrams), "{datagrams}");
    }
}
