//! What both ends keep about the datagrams of their connection: numbers, losses, noise, and what
//! waits to be sent.

use std::collections::VecDeque;

use crate::datagram::{Body, Datagram, Header};
use crate::session::DATAGRAM_BACKLOG_MAX;
use crate::{Arrival, Epoch, ParticipantId, SequenceWindow, ServerTime, Span};

/// Datagrams that were thrown away, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NoiseCounters {
    /// Not a datagram of this protocol.
    pub malformed: u64,
    /// Of an earlier or unknown life of the session.
    pub other_epoch: u64,
    /// Of somebody else's connection, or of a kind that this side does not take.
    pub misdirected: u64,
    /// Seen before.
    pub duplicate: u64,
    /// Too far behind.
    pub old: u64,
    /// Before the handshake was done.
    pub early: u64,
}

impl NoiseCounters {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.malformed
            + self.other_epoch
            + self.misdirected
            + self.duplicate
            + self.old
            + self.early
    }
}

/// How the connection does.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinkStats {
    /// Datagrams made here.
    pub sent: u64,
    /// Datagrams dropped here because they were not taken in time or could not be encoded.
    pub skipped: u64,
    /// Datagrams that arrived, each counted once.
    pub received: u64,
    /// Datagrams that the other side sent, as far as the newest number tells.
    pub expected: u64,
    /// Datagrams of ours that the other side has acknowledged.
    pub acknowledged: u64,
    /// Datagrams of ours up to the newest that is acknowledged.
    pub acknowledgeable: u64,
    /// Samples that were refused when sending: stale, not finite or out of range.
    pub samples_refused: u64,
    /// What was thrown away.
    pub noise: NoiseCounters,
    /// Round trip time, the newest measured; client only.
    pub rtt: Option<Span>,
    /// The artificial delay in force; client only.
    pub compensation: Option<Span>,
}

impl LinkStats {
    /// Share of the other side's datagrams that did not arrive, 0 to 1.
    pub fn loss_in(&self) -> f64 {
        lost(self.received, self.expected)
    }

    /// Share of our datagrams that the other side did not get, 0 to 1.
    pub fn loss_out(&self) -> f64 {
        lost(self.acknowledged, self.acknowledgeable)
    }
}

fn lost(got: u64, of: u64) -> f64 {
    if of == 0 {
        0.0
    } else {
        1.0 - (got as f64 / of as f64).min(1.0)
    }
}

/// The datagram side of one end. Closed until [`open`](Self::open): what comes before is noise.
#[derive(Debug, Default)]
pub(super) struct Link {
    identity: Option<(Epoch, ParticipantId)>,
    /// Numbers begin with 1, so that 0 can say that nothing has arrived yet.
    last_sequence: u32,
    arrived: SequenceWindow,
    acknowledged: SequenceWindow,
    waiting: VecDeque<Body>,
    stats: LinkStats,
}

impl Link {
    pub(super) fn open(&mut self, epoch: Epoch, participant: ParticipantId) {
        self.identity = Some((epoch, participant));
    }

    /// The content of a datagram that is to be read; everything else is counted.
    pub(super) fn accept(&mut self, bytes: &[u8]) -> Option<Datagram> {
        let noise = &mut self.stats.noise;
        let Some((epoch, participant)) = self.identity else {
            noise.early += 1;
            return None;
        };
        let Ok(datagram) = Datagram::decode(bytes) else {
            noise.malformed += 1;
            return None;
        };
        if datagram.header.epoch != epoch {
            noise.other_epoch += 1;
            return None;
        }
        if datagram.header.stream != participant {
            noise.misdirected += 1;
            return None;
        }
        match self.arrived.insert(datagram.header.sequence) {
            Arrival::New | Arrival::Late => {}
            Arrival::Duplicate => {
                noise.duplicate += 1;
                return None;
            }
            Arrival::Old => {
                noise.old += 1;
                return None;
            }
        }
        self.note_acknowledgement(datagram.header.newest, datagram.header.bits);
        Some(datagram)
    }

    fn note_acknowledgement(&mut self, newest: u32, bits: u32) {
        // A peer can claim what it likes, but not about datagrams that do not exist.
        if newest == 0 || newest > self.last_sequence {
            return;
        }
        for i in (0..32_u32).rev().filter(|i| bits >> i & 1 == 1) {
            if let Some(n) = newest.checked_sub(1 + i).filter(|n| *n > 0) {
                self.acknowledged.insert(n);
            }
        }
        self.acknowledged.insert(newest);
    }

    pub(super) fn count_misdirected(&mut self) {
        self.stats.noise.misdirected += 1;
    }

    pub(super) fn count_refused_samples(&mut self, n: usize) {
        self.stats.samples_refused += n as u64;
    }

    /// Adds to what waits; when full, the oldest goes: newer motion is worth more.
    pub(super) fn enqueue(&mut self, body: Body) {
        if self.waiting.len() == DATAGRAM_BACKLOG_MAX {
            self.waiting.pop_front();
            self.stats.skipped += 1;
        }
        self.waiting.push_back(body);
    }

    /// The next of what waits, encoded now.
    pub(super) fn pop(&mut self, generated: ServerTime) -> Option<Vec<u8>> {
        while let Some(body) = self.waiting.pop_front() {
            if let Some(bytes) = self.encode(body, generated) {
                return Some(bytes);
            }
        }
        None
    }

    /// A datagram of this side. `None`, and counted, where it can not be encoded or the link is
    /// not open.
    pub(super) fn encode(&mut self, body: Body, generated: ServerTime) -> Option<Vec<u8>> {
        let (epoch, stream) = self.identity?;
        let (newest, bits) = self.arrived.acknowledgement().unwrap_or((0, 0));
        let sequence = self.last_sequence.wrapping_add(1).max(1);
        let header = Header {
            epoch,
            stream,
            sequence,
            generated,
            newest,
            bits,
        };
        let Ok(bytes) = (Datagram { header, body }).encode() else {
            self.stats.skipped += 1;
            return None;
        };
        self.last_sequence = sequence;
        self.stats.sent += 1;
        Some(bytes)
    }

    pub(super) fn stats(&self) -> LinkStats {
        LinkStats {
            received: self.arrived.received(),
            expected: self.arrived.expected(),
            acknowledged: self.acknowledged.received(),
            acknowledgeable: self.acknowledged.expected(),
            ..self.stats
        }
    }
}
