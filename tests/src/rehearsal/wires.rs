//! What lies between the two ends of every session: an emulated network, and for the operations
//! stream what a reliable transport makes of it.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use crate::relay::{Direction, Fates, Profile};

/// Bytes of a stream that go as one packet.
const SEGMENT_BYTES: usize = 1100;

/// A lost segment is sent again after so long, µs: as a transport does that has seen a round trip of a
/// quarter of a second. It is waited for; what came after it is kept.
const AGAIN_US: i64 = 300_000;

/// A datagram that is older than this was lost for good, whatever its fate says, µs.
const LIFE_US: i64 = 60_000_000;

/// What arrives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Arrived {
    /// At the server, in order.
    StreamUp(Vec<u8>),
    /// At the server.
    DatagramUp(Vec<u8>),
    /// At a participant, in order.
    StreamDown(Vec<u8>),
    /// At a participant.
    DatagramDown(Vec<u8>),
}

/// What is on its way.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Packet {
    Datagram(Vec<u8>),
    /// Its place in the stream.
    Segment(u64, Vec<u8>),
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct OnTheWay {
    at_us: i64,
    /// Of two that arrive together the one that was sent first comes first.
    order: u64,
    seat: usize,
    is_up: bool,
    packet: Packet,
}

/// One direction of one session.
#[derive(Debug, Default)]
struct Way {
    packets: u64,
    last_us: i64,
    next_out: u64,
    next_in: u64,
    early: BTreeMap<u64, Vec<u8>>,
}

/// All sessions' wires.
#[derive(Debug)]
pub(super) struct Wires {
    fates: Fates,
    ways: BTreeMap<(usize, bool), Way>,
    queue: BinaryHeap<Reverse<OnTheWay>>,
    order: u64,
    bytes: [u64; 2],
}

impl Wires {
    pub(super) fn new(profile: &Profile, seed: u64) -> Self {
        Self {
            fates: Fates::new(profile.clone(), seed),
            ways: BTreeMap::new(),
            queue: BinaryHeap::new(),
            order: 0,
            bytes: [0; 2],
        }
    }

    pub(super) fn send_datagram_up(&mut self, seat: usize, bytes: Vec<u8>, at_us: i64) {
        self.send(seat, true, Packet::Datagram(bytes), at_us);
    }

    pub(super) fn send_datagram_down(&mut self, seat: usize, bytes: Vec<u8>, at_us: i64) {
        self.send(seat, false, Packet::Datagram(bytes), at_us);
    }

    pub(super) fn send_stream_up(&mut self, seat: usize, bytes: &[u8], at_us: i64) {
        self.send_stream(seat, true, bytes, at_us);
    }

    pub(super) fn send_stream_down(&mut self, seat: usize, bytes: &[u8], at_us: i64) {
        self.send_stream(seat, false, bytes, at_us);
    }

    fn send_stream(&mut self, seat: usize, is_up: bool, bytes: &[u8], at_us: i64) {
        for piece in bytes.chunks(SEGMENT_BYTES) {
            let way = self.ways.entry((seat, is_up)).or_default();
            let n = way.next_out;
            way.next_out += 1;
            self.send(seat, is_up, Packet::Segment(n, piece.to_vec()), at_us);
        }
    }

    fn send(&mut self, seat: usize, is_up: bool, packet: Packet, at_us: i64) {
        let direction = if is_up { Direction::Up } else { Direction::Down };
        let is_reliable = matches!(packet, Packet::Segment(..));
        let len = match &packet {
            Packet::Datagram(bytes) | Packet::Segment(_, bytes) => bytes.len(),
        };
        let mut sent_us = at_us;
        let (copies, due_us) = loop {
            let way = self.ways.entry((seat, is_up)).or_default();
            let fate = self.fates.fate(seat as u64, direction, way.packets);
            way.packets += 1;
            self.bytes[usize::from(is_up)] += len as u64;
            let mut due = sent_us + fate.delay_us as i64;
            if fate.copies > 0 {
                if !self.fates.profile().reorder && !is_reliable {
                    due = due.max(way.last_us);
                    way.last_us = due;
                }
                break (fate.copies, due);
            }
            sent_us += AGAIN_US;
            if !is_reliable || sent_us - at_us > LIFE_US {
                return;
            }
        };
        for _ in 0..copies {
            self.order += 1;
            self.queue.push(Reverse(OnTheWay {
                at_us: due_us,
                order: self.order,
                seat,
                is_up,
                packet: packet.clone(),
            }));
        }
    }

    /// The next that has arrived by `until_us`: when, for or from which seat, and what.
    pub(super) fn pop_due(&mut self, until_us: i64) -> Option<(i64, usize, Arrived)> {
        while self.queue.peek().is_some_and(|Reverse(p)| p.at_us <= until_us) {
            let Reverse(p) = self.queue.pop()?;
            let arrived = match p.packet {
                Packet::Datagram(bytes) if p.is_up => Arrived::DatagramUp(bytes),
                Packet::Datagram(bytes) => Arrived::DatagramDown(bytes),
                Packet::Segment(n, bytes) => {
                    let way = self.ways.entry((p.seat, p.is_up)).or_default();
                    if n >= way.next_in {
                        way.early.insert(n, bytes);
                    }
                    let mut whole = Vec::new();
                    while let Some(next) = way.early.remove(&way.next_in) {
                        way.next_in += 1;
                        whole.extend(next);
                    }
                    if whole.is_empty() {
                        continue;
                    }
                    if p.is_up {
                        Arrived::StreamUp(whole)
                    } else {
                        Arrived::StreamDown(whole)
                    }
                }
            };
            return Some((p.at_us, p.seat, arrived));
        }
        None
    }

    /// Counts bytes from now on.
    pub(super) fn count_from_here(&mut self) {
        self.bytes = [0; 2];
    }

    /// Bytes of all participants, up and down; what was sent again counts again.
    pub(super) fn counted(&self) -> (u64, u64) {
        (self.bytes[1], self.bytes[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_arrives_whole_and_in_order_over_a_network_that_loses_and_reorders() {
        let mut wires = Wires::new(&Profile::named("lossy").unwrap(), 3);
        let sent: Vec<u8> = (0..40_000_u32).map(|i| (i % 251) as u8).collect();
        for (i, piece) in sent.chunks(97).enumerate() {
            wires.send_stream_up(0, piece, i as i64 * 1000);
            wires.send_datagram_up(0, vec![1], i as i64 * 1000);
        }
        let mut back = Vec::new();
        let mut datagrams = 0;
        let mut last = 0;
        while let Some((at_us, seat, arrived)) = wires.pop_due(i64::MAX) {
            assert!(at_us >= last && seat == 0);
            last = at_us;
            match arrived {
                Arrived::StreamUp(bytes) => back.extend(bytes),
                Arrived::DatagramUp(_) => datagrams += 1,
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(back, sent);
        assert!((280..400).contains(&datagrams), "{datagrams}");
    }
}
