//! What both ends keep about the datagrams of their connection: numbers, losses, noise.

use std::collections::VecDeque;

use crate::datagram::{Body, Datagram, Header};
use crate::session::DATAGRAM_BACKLOG_MAX;
use crate::{Epoch, ParticipantId, ProtocolError, SequenceWindow, ServerTime, Span};

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

/// How the connection does.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinkStats {
    /// Datagrams made here.
    pub sent: u64,
    /// Datagrams dropped here because they were not taken in time.
    pub skipped: u64,
    /// Datagrams that arrived, each counted once.
    pub received: u64,
    /// Datagrams that the other side sent, as far as the newest number tells.
    pub expected: u64,
    /// Datagrams of ours that the other side has acknowledged.
    pub acknowledged: u64,
    /// Newest of our numbers, plus one, that an acknowledgement speaks about.
    pub acknowledgeable: u64,
    /// Samples that were refused when sending: stale, not finite or out of range.
    pub samples_refused: u64,
    /// What was thrown away.
    pub noise: NoiseCounters,
    /// Round trip time, the newest measured; client only.
    pub rtt: Option<Span>,
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
