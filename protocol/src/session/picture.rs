//! The picture stream of a thin subscriber: node displacements within a fixed rate.
//!
//! ```text
//! at every picture, for each node in view
//!   error = |displacement - last displacement sent|   acknowledged or in flight; below one step it counts as 0
//!   the nodes with the largest errors go first, as many as the rate allows; the others wait
//! rate   a token bucket that fills with 1 Mbit/s; all traffic to this subscriber is taken from it
//! ```
//!
//! A node counts as known only when its datagram was acknowledged. Without an acknowledgement within
//! [twice the usual time](PictureStream::overdue) it is sent again. After losses and with the tissue at
//! rest, every node is therefore within a step of the server's displacement.

use std::collections::VecDeque;
use std::sync::Arc;

use super::Link;
use crate::datagram::shape::NODES_MAX;
use crate::datagram::{Body, DATAGRAM_MAX_BYTES, Displacements};
use crate::{ServerTime, Span};

/// Step of a thin subscriber's displacements, µm: rounding to it moves a node by at most 0.043 mm.
pub const PICTURE_STEP_UM: u16 = 50;

/// The total rate of a thin subscriber, bits per second, including UDP, IP and QUIC overhead.
pub const PICTURE_RATE_BITS_PER_S: u32 = 1_000_000;

/// Bytes per second of the same.
const RATE: f64 = PICTURE_RATE_BITS_PER_S as f64 / 8.0;

/// Overhead of a datagram in bytes: 40 for IPv6, 8 for UDP, 30 for QUIC's header, its authentication tag
/// and the frame header.
const OVERHEAD_BYTES: usize = 78;

/// Depth of the token bucket, s: two frames at 60 Hz, so that a late tick loses nothing.
const SAVED_S: f64 = 1.0 / 30.0;

/// The longest time that a large message (the initial log, a burst of motion) may delay the picture, s.
const DEBT_S: f64 = 0.5;

/// The smallest budget in bytes for which a datagram is started: below it the overhead dominates.
const BUDGET_MIN_BYTES: f64 = 200.0;

/// Size of the header, topology, time and step of a datagram with displacements, bytes.
const HEAD_BYTES: f64 = 26.0;

/// Initial estimate of bytes per node, measured on a press.
const NODE_BYTES_FIRST: f64 = 1.3;

/// Adaptation rate of the estimate.
const FOLLOW: f64 = 0.1;

/// The most datagrams in flight: a second at twice the rate of full ones. Beyond, the oldest counts as
/// lost.
const IN_FLIGHT_MAX: usize = 256;

/// The shortest and the longest time after which an unacknowledged datagram counts as lost.
const OVERDUE_MIN: Span = Span::from_millis(100);
const OVERDUE_MAX: Span = Span::from_millis(1500);

/// The displacements of all nodes in view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Picture {
    /// The topology that the node numbers belong to.
    pub topology_version: u32,
    /// The time of the displacements.
    pub view_time: ServerTime,
    /// The nodes in view, ascending.
    pub nodes: Arc<[u32]>,
    /// The displacement of each of them from its rest position, m.
    pub displacements: Vec<[f32; 3]>,
}

/// Statistics of a picture stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PictureStats {
    /// Nodes with an error above one step that did not fit into the newest picture.
    pub waiting: u64,
    /// Node displacements sent, repetitions included.
    pub sent: u64,
    /// Node displacements sent again because their datagram was not acknowledged.
    pub resent: u64,
    /// Bytes to this subscriber, including overhead.
    pub bytes: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum DeliveryState {
    /// Never sent, or lost: the client displays `known`.
    #[default]
    Unsent,
    /// Sent in the datagram of this number.
    InFlight(u32),
    Known,
}

/// The client's knowledge of one node.
#[derive(Debug, Clone, Copy, Default)]
struct SentNode {
    /// The displacement last sent, steps.
    last: [i16; 3],
    /// The displacement last acknowledged, steps.
    known: [i16; 3],
    /// Whether any displacement was acknowledged.
    is_known: bool,
    fate: DeliveryState,
}

/// A datagram in flight.
#[derive(Debug)]
struct Flight {
    sequence: u32,
    sent: ServerTime,
    nodes: Vec<u32>,
}

/// The pictures of one thin subscriber.
#[derive(Debug, Default)]
pub(super) struct PictureStream {
    newest: Option<Arc<Picture>>,
    /// Whether the newest picture is not yet divided into pieces.
    is_fresh: bool,
    /// By node number; as long as the largest number in view.
    sent: Vec<SentNode>,
    /// The topology of the nodes.
    topology_version: u32,
    /// Chosen pieces of the newest picture that are not sent yet.
    pieces: VecDeque<Displacements>,
    flights: VecDeque<Flight>,
    /// The token bucket in bytes; negative after overspending.
    budget: f64,
    filled: Option<ServerTime>,
    node_bytes: Option<f64>,
    /// The usual time from sending to acknowledgement.
    usual: Option<Span>,
    stats: PictureStats,
}

impl PictureStream {
    /// Takes a newer picture; the nodes to send are chosen again.
    pub(super) fn show(&mut self, picture: &Arc<Picture>) {
        self.newest = Some(Arc::clone(picture));
        self.is_fresh = true;
        self.pieces.clear();
    }

    /// Accounts for `bytes` of a datagram or of the stream to this subscriber.
    pub(super) fn charge(&mut self, bytes: usize) {
        let cost = bytes + OVERHEAD_BYTES;
        self.stats.bytes += cost as u64;
        self.budget = (self.budget - cost as f64).max(-DEBT_S * RATE);
    }

    /// Notes acknowledged datagrams.
    pub(super) fn acknowledge(&mut self, sequences: &[u32], now: ServerTime) {
        for sequence in sequences {
            let Some(at) = self.flights.iter().position(|f| f.sequence == *sequence) else {
                continue;
            };
            let Some(flight) = self.flights.remove(at) else {
                continue;
            };
            let took = now - flight.sent;
            let usual = self.usual.get_or_insert(took);
            // The estimate falls slowly and rises quickly: a late retransmission costs a moment, an
            // early one bytes.
            let part = if took > *usual { 2 } else { 16 };
            *usual = *usual + Span::from_micros((took - *usual).as_micros() / part);
            for node in flight.nodes {
                let Some(sent) = self.sent.get_mut(node as usize) else {
                    continue;
                };
                if sent.fate == DeliveryState::InFlight(flight.sequence) {
                    sent.fate = DeliveryState::Known;
                    sent.known = sent.last;
                    sent.is_known = true;
                }
            }
        }
    }

    /// The time after which an unacknowledged datagram counts as lost: twice the usual time.
    pub(super) fn overdue(&self) -> Span {
        let twice = self.usual.map_or(OVERDUE_MAX, |u| u + u);
        twice.clamp(OVERDUE_MIN, OVERDUE_MAX)
    }

    /// The next datagram, if the budget allows one and a node has an error.
    pub(super) fn next(&mut self, link: &mut Link, now: ServerTime) -> Option<Vec<u8>> {
        self.fill(now);
        if self.is_fresh {
            self.is_fresh = false;
            self.give_up_overdue(now);
            self.choose();
        }
        while self.budget >= BUDGET_MIN_BYTES {
            let piece = self.pieces.pop_front()?;
            match link.encode_whole(Body::Displacements(piece), now) {
                Ok((sequence, bytes, Body::Displacements(piece))) => {
                    self.note_sent(sequence, bytes.len(), &piece, now);
                    return Some(bytes);
                }
                // No other body is queued here.
                Ok(_) => return None,
                Err(Some(body)) => self.halve(body),
                Err(None) => {}
            }
        }
        None
    }

    pub(super) fn stats(&self) -> PictureStats {
        self.stats
    }

    fn fill(&mut self, now: ServerTime) {
        let since = self.filled.map_or(0.0, |t| (now - t).as_secs_f64());
        self.filled = Some(now);
        self.budget = (self.budget + since.max(0.0) * RATE).min(SAVED_S * RATE);
    }

    fn halve(&mut self, body: Body) {
        if let Some((Body::Displacements(a), Body::Displacements(b))) = body.halves() {
            self.pieces.push_front(b);
            self.pieces.push_front(a);
        }
    }

    fn give_up_overdue(&mut self, now: ServerTime) {
        let overdue = self.overdue();
        while let Some(first) = self.flights.front() {
            let is_lost = now - first.sent > overdue || self.flights.len() > IN_FLIGHT_MAX;
            if !is_lost {
                return;
            }
            let Some(flight) = self.flights.pop_front() else {
                return;
            };
            for node in flight.nodes {
                let Some(sent) = self.sent.get_mut(node as usize) else {
                    continue;
                };
                if sent.fate == DeliveryState::InFlight(flight.sequence) {
                    sent.fate = DeliveryState::Unsent;
                    self.stats.resent += 1;
                }
            }
        }
    }

    fn note_sent(&mut self, sequence: u32, bytes: usize, piece: &Displacements, now: ServerTime) {
        let each = (bytes as f64 - HEAD_BYTES).max(1.0) / piece.nodes.len().max(1) as f64;
        let guess = self.node_bytes.get_or_insert(each);
        *guess += FOLLOW * (each - *guess);
        for (node, displacement) in &piece.nodes {
            let Some(sent) = self.sent.get_mut(*node as usize) else {
                continue;
            };
            sent.last = steps(*displacement);
            sent.fate = DeliveryState::InFlight(sequence);
        }
        self.stats.sent += piece.nodes.len() as u64;
        self.flights.push_back(Flight {
            sequence,
            sent: now,
            nodes: piece.nodes.iter().map(|n| n.0).collect(),
        });
    }

    /// Chooses the nodes of the newest picture to send, and divides them into pieces of a datagram each.
    fn choose(&mut self) {
        let Some(picture) = self.newest.clone() else {
            return;
        };
        let longest = picture.nodes.last().map_or(0, |n| *n as usize + 1);
        if picture.topology_version > self.topology_version + 1 {
            // An undo and a cut between two pictures may have given numbers to other nodes.
            self.sent.clear();
        }
        self.topology_version = picture.topology_version;
        // An undo removes the nodes with the largest numbers; a later cut gives the numbers to others.
        self.sent.resize(longest, SentNode::default());
        let all = picture.nodes.iter().zip(&picture.displacements);
        let mut off: Vec<(f32, u32, [f32; 3])> = all
            .filter_map(|(node, d)| Some((self.sent[*node as usize].off(*d)?, *node, *d)))
            .collect();
        let node_bytes = self.node_bytes.unwrap_or(NODE_BYTES_FIRST);
        let fit = |bytes: f64| ((bytes - HEAD_BYTES).max(0.0) / node_bytes) as usize;
        let whole = (fit(0.95 * DATAGRAM_MAX_BYTES as f64)).clamp(1, NODES_MAX);
        let full = (DATAGRAM_MAX_BYTES + OVERHEAD_BYTES) as f64;
        let datagrams = (self.budget / full).max(0.0).floor();
        let rest = self.budget - datagrams * full - OVERHEAD_BYTES as f64;
        let room = datagrams as usize * whole + fit(rest).min(whole);
        self.stats.waiting = off.len().saturating_sub(room) as u64;
        if off.len() > room {
            if room == 0 {
                return;
            }
            off.select_nth_unstable_by(room - 1, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            off.truncate(room);
        }
        off.sort_unstable_by_key(|(_, node, _)| *node);
        // Pieces of equal length: a short one at the end would cost as much overhead as a long one.
        let pieces = off.len().div_ceil(whole).max(1);
        let length = off.len().div_ceil(pieces).max(1);
        self.pieces = off
            .chunks(length)
            .map(|chunk| Displacements {
                step_um: PICTURE_STEP_UM,
                topology_version: picture.topology_version,
                view_time: picture.view_time,
                waiting: u32::try_from(self.stats.waiting).unwrap_or(u32::MAX),
                nodes: chunk.iter().map(|(_, node, d)| (*node, *d)).collect(),
            })
            .collect();
    }
}

impl SentNode {
    /// The error of a node relative to the displacement sent, in steps; `None` below the threshold.
    fn off(&self, displacement: [f32; 3]) -> Option<f32> {
        let (at, is_sent) = match self.fate {
            DeliveryState::Unsent => (self.known, false),
            DeliveryState::InFlight(_) | DeliveryState::Known => (self.last, true),
        };
        let step = f32::from(PICTURE_STEP_UM) * 1e-6;
        let parts = (0..3).map(|i| displacement[i] / step - f32::from(at[i]));
        let off = parts.map(|x| x * x).sum::<f32>().sqrt();
        // The error of an unknown node is unknown: it goes before nodes with small errors.
        if is_sent {
            (off > 1.0).then_some(off)
        } else {
            Some(off + 1.0)
        }
    }
}

/// A displacement in metres as steps on the wire.
fn steps(displacement: [f32; 3]) -> [i16; 3] {
    let step = f64::from(PICTURE_STEP_UM) * 1e-6;
    displacement.map(|x| (f64::from(x) / step).round() as i16)
}

#[cfg(test)]
mod tests;
