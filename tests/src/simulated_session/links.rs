//! Emulated links between the server and the sites of a simulated session.
//!
//! ```text
//! datagram -> path -> datagram                    a lost one is gone
//! segment  -> path -> buffer -> stream in order   a lost one is sent again after a timeout
//! ```
//!
//! A packet arrives once or never: authentication rejects damaged packets, and packet numbers reject copies.

use std::collections::BTreeMap;

use clap::ValueEnum;
use serde::Serialize;

use crate::network::{Direction, EventQueue, Path, Profile};

/// Bit of a datagram's first byte that announces an acknowledgement, and the acknowledgement's size in
/// bytes.
const ACKNOWLEDGES: u8 = 0x08;
const ACKNOWLEDGEMENT_BYTES: u16 = 6;
const SEGMENT_BYTES: usize = 1100;

/// Maximum number of logged packets: one hour of one participant.
const SENT_MAX: usize = 4_000_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    Operations,
    Motion,
    Corrections,
    Clock,
    /// Delay reports and heartbeats.
    Delays,
}

impl Part {
    /// The purpose of a datagram, from the kind in its first byte.
    fn of_datagram(bytes: &[u8]) -> Self {
        match bytes.first().map_or(0, |b| b & 0x07) {
            1 => Self::Motion,
            3 | 4 => Self::Clock,
            5 => Self::Delays,
            7 => Self::Operations,
            _ => Self::Corrections,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// Send time, µs of true time.
    pub at_us: u64,
    pub seat: usize,
    pub direction: Direction,
    pub part: Part,
    /// Bytes of the acknowledgement it carries.
    pub acknowledgement: u16,
    /// Total size in bytes, without QUIC overhead.
    pub bytes: u16,
    /// Arrival, µs of true time; `None` if it was lost.
    pub arrives_us: Option<u64>,
}

pub(crate) trait Payload {
    fn bytes(&self) -> usize;

    /// Purpose of a datagram with this content, and the bytes of its acknowledgement.
    fn purpose(&self) -> (Part, u16);
}

impl Payload for Vec<u8> {
    fn bytes(&self) -> usize {
        self.len()
    }

    fn purpose(&self) -> (Part, u16) {
        let acknowledges = self.first().is_some_and(|b| b & ACKNOWLEDGES != 0);
        let bytes = if acknowledges {
            ACKNOWLEDGEMENT_BYTES
        } else {
            0
        };
        (Part::of_datagram(self), bytes)
    }
}

/// An arrival at the server (uplink) or at a site (downlink).
#[derive(Debug)]
pub(crate) struct Delivery<P> {
    /// True time, µs.
    pub(crate) at_us: i64,
    pub(crate) seat: usize,
    pub(crate) direction: Direction,
    pub(crate) arrived: Arrived<P>,
}

#[derive(Debug)]
pub(crate) enum Arrived<P> {
    Datagram(P),
    /// The next segments of the stream.
    Stream(Vec<P>),
}

#[derive(Debug)]
enum Packet<P> {
    Datagram(P),
    /// Segment with its index in the stream.
    Segment(u64, P),
}

#[derive(Debug)]
struct Flight<P> {
    seat: usize,
    direction: Direction,
    packet: Packet<P>,
    /// Whether this is a lost segment that is due for retransmission.
    is_lost: bool,
}

#[derive(Debug)]
struct Flow<P> {
    path: Path,
    next_out: u64,
    next_in: u64,
    /// Received segments behind a missing one.
    early: BTreeMap<u64, P>,
    /// Bytes sent since the log was restarted; the log itself is bounded.
    bytes: u64,
}

#[derive(Debug)]
pub(crate) struct Links<P> {
    /// Uplink and downlink of each seat.
    flows: Vec<[Flow<P>; 2]>,
    queue: EventQueue<i64, Flight<P>>,
    resend_us: i64,
    log: Vec<Sent>,
}

impl<P: Payload> Links<P> {
    pub(crate) fn new(profiles: &[&Profile], seed: u64, resend_us: i64) -> Self {
        let pair = |(seat, profile): (usize, &&Profile)| {
            [Direction::Up, Direction::Down].map(|direction| Flow {
                path: Path::new(profile, seed, seat as u64, direction),
                next_out: 0,
                next_in: 0,
                early: BTreeMap::new(),
                bytes: 0,
            })
        };
        Self {
            flows: profiles.iter().enumerate().map(pair).collect(),
            queue: EventQueue::default(),
            resend_us,
            log: Vec::new(),
        }
    }

    /// Replaces the connection of a seat. Packets in flight are dropped and streams restart. The round trip
    /// of the connection setup is not simulated.
    pub(super) fn renew(&mut self, seat: usize) {
        self.queue.retain(|flight| flight.seat != seat);
        for flow in &mut self.flows[seat] {
            (flow.next_out, flow.next_in) = (0, 0);
            flow.early.clear();
        }
    }

    fn flow(&mut self, seat: usize, direction: Direction) -> &mut Flow<P> {
        &mut self.flows[seat][usize::from(direction == Direction::Down)]
    }

    /// Sends a datagram, which may be lost.
    pub(crate) fn send_datagram(&mut self, seat: usize, direction: Direction, at_us: i64, data: P) {
        self.transmit(seat, direction, at_us, Packet::Datagram(data));
    }

    pub(crate) fn send_segment(&mut self, seat: usize, direction: Direction, at_us: i64, data: P) {
        let flow = self.flow(seat, direction);
        let n = flow.next_out;
        flow.next_out += 1;
        self.transmit(seat, direction, at_us, Packet::Segment(n, data));
    }

    fn transmit(&mut self, seat: usize, direction: Direction, at_us: i64, packet: Packet<P>) {
        let (bytes, (part, acknowledgement)) = match &packet {
            Packet::Datagram(data) => (data.bytes(), data.purpose()),
            Packet::Segment(_, data) => (data.bytes(), (Part::Operations, 0)),
        };
        let sent_us = at_us.unsigned_abs();
        let flow = self.flow(seat, direction);
        flow.bytes += bytes as u64;
        let arrivals = flow.path.send(sent_us, bytes);
        let arrival = arrivals.iter().find(|a| a.corrupted.is_none());
        if self.log.len() < SENT_MAX {
            self.log.push(Sent {
                at_us: sent_us,
                seat,
                direction,
                part,
                acknowledgement,
                bytes: u16::try_from(bytes).unwrap_or(u16::MAX),
                arrives_us: arrival.map(|a| a.at_us),
            });
        }
        let next_us = match (arrival, &packet) {
            (Some(arrival), _) => arrival.at_us as i64,
            (None, Packet::Segment(..)) => at_us + self.resend_us,
            (None, Packet::Datagram(_)) => return,
        };
        let flight = Flight {
            seat,
            direction,
            packet,
            is_lost: arrival.is_none(),
        };
        self.queue.push(next_us, flight);
    }

    pub(crate) fn pop_due(&mut self, until_us: i64) -> Option<Delivery<P>> {
        loop {
            let (at_us, flight) = self.queue.pop_due(until_us)?;
            let (seat, direction) = (flight.seat, flight.direction);
            if flight.is_lost {
                self.transmit(seat, direction, at_us, flight.packet);
                continue;
            }
            let arrived = match flight.packet {
                Packet::Datagram(data) => Arrived::Datagram(data),
                Packet::Segment(n, data) => {
                    let complete = self.flow(seat, direction).accept(n, data);
                    if complete.is_empty() {
                        continue;
                    }
                    Arrived::Stream(complete)
                }
            };
            return Some(Delivery {
                at_us,
                seat,
                direction,
                arrived,
            });
        }
    }

    /// Empties the packet log and the byte counts.
    pub(crate) fn restart_log(&mut self) {
        self.log.clear();
        for flow in self.flows.iter_mut().flatten() {
            flow.bytes = 0;
        }
    }

    /// Bytes that the first `seats` sites sent or received since the log was restarted, with retransmissions.
    pub(crate) fn bytes_sent(&self, direction: Direction, seats: usize) -> u64 {
        let index = usize::from(direction == Direction::Down);
        self.flows[..seats]
            .iter()
            .map(|pair| pair[index].bytes)
            .sum()
    }

    pub(crate) fn take_log(&mut self) -> Vec<Sent> {
        std::mem::take(&mut self.log)
    }
}

impl Links<Vec<u8>> {
    pub(crate) fn send_stream(
        &mut self,
        seat: usize,
        direction: Direction,
        at_us: i64,
        bytes: &[u8],
    ) {
        for piece in bytes.chunks(SEGMENT_BYTES) {
            self.send_segment(seat, direction, at_us, piece.to_vec());
        }
    }
}

impl<P> Flow<P> {
    /// Accepts a segment and returns those that are now complete in order.
    fn accept(&mut self, n: u64, data: P) -> Vec<P> {
        self.early.insert(n, data);
        let mut complete = Vec::new();
        while let Some(next) = self.early.remove(&self.next_in) {
            self.next_in += 1;
            complete.push(next);
        }
        complete
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
                Body::Copy(_) => Part::Operations,
            };
            assert_eq!(Part::of_datagram(&bytes.message), part, "{}", example.name);
            let acknowledges = bytes.message[0] & ACKNOWLEDGES != 0;
            assert_eq!(acknowledges, header.acknowledged.is_some());
        }
    }

    #[test]
    fn stream_is_complete_and_ordered_despite_loss_and_reordering() {
        let lossy = Profile::named("lossy").unwrap();
        let mut links = Links::new(&[&lossy; 2], 3, 300_000);
        let sent: Vec<u8> = (0..40_000_u32).map(|i| (i % 251) as u8).collect();
        for (i, piece) in sent.chunks(97).enumerate() {
            let at_us = i as i64 * 1000;
            links.send_stream(1, Direction::Up, at_us, piece);
            links.send_datagram(1, Direction::Up, at_us, vec![1]);
        }
        let (mut back, mut datagrams, mut last) = (Vec::new(), 0, 0);
        while let Some(delivery) = links.pop_due(i64::MAX) {
            assert!(delivery.at_us >= last);
            assert_eq!((delivery.seat, delivery.direction), (1, Direction::Up));
            last = delivery.at_us;
            match delivery.arrived {
                Arrived::Stream(bytes) => back.extend(bytes.concat()),
                Arrived::Datagram(_) => datagrams += 1,
            }
        }
        assert_eq!(back, sent);
        assert!((280..400).contains(&datagrams), "{datagrams}");
    }
}
