//! The datagram state of both ends of a connection: sequence numbers, losses, noise, and the send queue.

use std::collections::VecDeque;

use crate::datagram::{
    Acknowledgement, Body, Datagram, Expected, Header, Memory, Opened, SHORT_SEQUENCE, SHORT_TIME,
    TRACKS_MAX, Tag,
};
use crate::lateness::{LocalStalls, Repeated, StallCounter};
use crate::session::loss::LossEstimate;
use crate::session::{DATAGRAM_BACKLOG_MAX, MessageCopy};
use crate::timeline::GAP_LIMIT;
use crate::{
    Arrival, Epoch, ParticipantId, ProtocolError, SequenceWindow, ServerTime, Span, ToolTrack,
};

/// An acknowledgement is sent after this many datagrams: its bits cover 33, so that each number is
/// acknowledged four times and a loss of three in a row costs nothing.
const ACKNOWLEDGE_EVERY: u32 = 8;

/// The longest time until an acknowledgement, if any datagram has arrived.
const ACKNOWLEDGE_WITHIN: Span = Span::from_millis(40);

/// Times of sent datagrams that are kept until they are acknowledged.
const TIMES_KEPT_MAX: usize = 256;

/// Dropped datagrams, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NoiseCounters {
    /// Not a datagram of this protocol.
    pub malformed: u64,
    /// Datagrams of an earlier or unknown incarnation of the session.
    pub other_epoch: u64,
    /// Datagrams of another connection, or of a kind that this side does not accept.
    pub misdirected: u64,
    /// Seen before.
    pub duplicate: u64,
    /// Too far behind.
    pub old: u64,
    /// Before the handshake was done.
    pub early: u64,
    /// Differences to an unknown baseline.
    pub no_baseline: u64,
    /// Acknowledgements of datagrams that were never sent; the rest of such a datagram is read.
    pub false_acknowledgement: u64,
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
            + self.no_baseline
            + self.false_acknowledgement
    }
}

/// Statistics of the connection.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinkStats {
    /// Datagrams sent.
    pub sent: u64,
    /// Datagrams dropped here because they waited too long or could not be encoded.
    pub skipped: u64,
    /// Datagrams that arrived, each counted once.
    pub received: u64,
    /// Datagrams that the other side sent, inferred from the newest number.
    pub expected: u64,
    /// Sent datagrams that the other side has acknowledged.
    pub acknowledged: u64,
    /// Samples that were refused when sending: stale, not finite or out of range.
    pub samples_refused: u64,
    /// Lateness that this machine caused: of datagrams received, and of motion sent.
    pub local_stalls: LocalStalls,
    /// The rejected datagrams by kind.
    pub noise: NoiseCounters,
    /// Round trip time, the newest measured; client only.
    pub rtt: Option<Span>,
    /// The artificial delay in force; client only.
    pub compensation: Option<Span>,
}

impl LinkStats {
    /// Share of the other side's datagrams that did not arrive, 0 to 1.
    pub fn loss_in(&self) -> f64 {
        if self.expected == 0 {
            0.0
        } else {
            1.0 - (self.received as f64 / self.expected as f64).min(1.0)
        }
    }
}

/// A sent datagram.
#[derive(Debug, Clone, Copy)]
struct SentAt {
    sequence: u32,
    /// The time in it.
    generated: ServerTime,
    /// When it left.
    left: ServerTime,
}

/// The datagram side of one end. Closed until [`open`](Self::open): earlier datagrams are noise.
#[derive(Debug, Default)]
pub(super) struct Link {
    tag: Option<Tag>,
    /// Numbers start at 1; 0 means that nothing has arrived yet.
    last_sequence: u32,
    arrived: SequenceWindow,
    acknowledged: SequenceWindow,
    loss: LossEstimate,
    /// With the moments since which it waits.
    waiting: VecDeque<(Body, ServerTime)>,
    /// Baselines from the sent datagrams and from the received ones.
    sent: Memory,
    received: Memory,
    /// The newest sent datagrams.
    sent_at: VecDeque<SentAt>,
    /// The time in the newest acknowledged one.
    known_at: Option<ServerTime>,
    /// When the newest datagram left that the last accepted one was the first to acknowledge, and the longest loss
    /// before those.
    answered: Option<(ServerTime, Span)>,
    /// The newest acknowledged datagram, and when it left.
    answered_before: Option<(u32, ServerTime)>,
    /// The latest time in their datagrams.
    received_at: ServerTime,
    /// Datagrams that arrived since the last acknowledgement, and when that left.
    unacknowledged: u32,
    acknowledged_at: ServerTime,
    /// Sent datagrams that the newest received one was the first to acknowledge: at most 33.
    fresh: Vec<u32>,
    /// The reported lateness of the oldest news of every tool.
    claims: Vec<(ParticipantId, Repeated)>,
    stalls: StallCounter,
    stats: LinkStats,
}

impl Link {
    pub(super) fn open(&mut self, epoch: Epoch, participant: ParticipantId) {
        self.tag = Some(Tag {
            epoch,
            stream: participant,
        });
    }

    /// The content of a datagram that is to be read; everything else is counted.
    pub(super) fn accept(&mut self, bytes: &[u8]) -> Option<Datagram> {
        self.fresh.clear();
        self.answered = None;
        let Some(tag) = self.tag else {
            self.stats.noise.early += 1;
            return None;
        };
        let expected = Expected {
            tag,
            sequence: self.arrived.acknowledgement().map_or(0, |(n, _)| n),
            generated: self.received_at,
            sent: self.last_sequence,
        };
        let noise = &mut self.stats.noise;
        let opened = match Opened::read(bytes, &expected) {
            Ok(opened) => opened,
            Err(error) => {
                match error {
                    ProtocolError::OtherEpoch { .. } => noise.other_epoch += 1,
                    ProtocolError::OtherStream { .. } => noise.misdirected += 1,
                    _ => noise.malformed += 1,
                }
                return None;
            }
        };
        // The number is checked before the body is read and noted after: an unreadable datagram must not
        // be acknowledged, or it would become a baseline.
        let mut arrived = self.arrived.clone();
        let arrival = arrived.insert(opened.header.sequence);
        match arrival {
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
        let datagram = match opened.body(&mut self.received) {
            Ok(datagram) => datagram,
            Err(ProtocolError::NoBaseline { .. }) => {
                noise.no_baseline += 1;
                return None;
            }
            Err(_) => {
                noise.malformed += 1;
                return None;
            }
        };
        self.arrived = arrived;
        self.unacknowledged += 1;
        if arrival == Arrival::New {
            // For motion it is the time of a sample, which may be older than an earlier datagram's. The
            // other side completes its times relative to the latest, too.
            self.received_at = self.received_at.max(datagram.header.generated);
        }
        if let Some(a) = datagram.header.acknowledged {
            self.note_acknowledgement(a.newest, a.bits);
        }
        Some(datagram)
    }

    fn note_acknowledgement(&mut self, newest: u32, bits: u32) {
        // A peer may not acknowledge datagrams that do not exist.
        if newest == 0 || newest > self.last_sequence {
            self.stats.noise.false_acknowledgement += 1;
            return;
        }
        for i in (0..32_u32).rev().filter(|i| bits >> i & 1 == 1) {
            if let Some(n) = newest.checked_sub(1 + i).filter(|n| *n > 0) {
                self.acknowledge(n);
            }
        }
        self.acknowledge(newest);
        self.loss.note(newest, self.acknowledged.received());
    }

    /// Estimated share of this side's datagrams that do not arrive, 0 to 1.
    pub(super) fn loss_out(&self) -> f64 {
        self.loss.share()
    }

    fn acknowledge(&mut self, sequence: u32) {
        if self.acknowledged.insert(sequence).is_fresh() {
            self.sent.acknowledge(sequence);
            self.fresh.push(sequence);
            if let Some(sent) = self.sent_at.iter().find(|s| s.sequence == sequence) {
                self.known_at = self.known_at.max(Some(sent.generated));
                let (sequence, left) = (sent.sequence, sent.left);
                self.note_answer(sequence, left);
            }
        }
    }

    /// Acknowledgements come in the order of their numbers.
    fn note_answer(&mut self, sequence: u32, left: ServerTime) {
        let lost = match self.answered_before {
            Some((before, _)) if sequence <= before => return,
            Some((before, at)) if sequence > before + 1 => left - at,
            _ => Span::ZERO,
        };
        let longest = self.answered.map_or(Span::ZERO, |(_, lost)| lost);
        self.answered = Some((left, lost.max(longest)));
        self.answered_before = Some((sequence, left));
    }

    /// Sent datagrams that the last [accepted](Self::accept) one was the first to acknowledge.
    pub(super) fn fresh(&self) -> &[u32] {
        &self.fresh
    }

    /// The longest delay that the last [accepted](Self::accept) datagram shows until `now`: the round trip of the newest
    /// datagram that it acknowledges first, with the wait of the acknowledgement for its datagram, and the loss before
    /// it. A loss counts up to [`GAP_LIMIT`], because a peer can pretend it, and timelines bridge no longer one.
    pub(super) fn round_trip(&self, now: ServerTime) -> Option<Span> {
        self.answered
            .map(|(left, lost)| now - left + lost.min(GAP_LIMIT))
    }

    pub(super) fn count_misdirected(&mut self) {
        self.stats.noise.misdirected += 1;
    }

    pub(super) fn count_malformed(&mut self) {
        self.stats.noise.malformed += 1;
    }

    pub(super) fn count_old(&mut self) {
        self.stats.noise.old += 1;
    }

    pub(super) fn count_refused_samples(&mut self, n: usize) {
        self.stats.samples_refused += n as u64;
    }

    /// Counts lateness that this machine caused.
    pub(super) fn count_stall(&mut self, stall: Span) {
        self.stalls.add(stall);
    }

    /// Appends to the send queue. A full queue drops the oldest entry, because newer motion is more
    /// valuable. Waiting time of motion after `since` counts as lateness of this machine.
    pub(super) fn enqueue(&mut self, body: Body, since: ServerTime) {
        self.waiting.push_back((body, since));
        if self.waiting.len() > DATAGRAM_BACKLOG_MAX {
            self.stats.skipped += 1;
            if let Some((Body::Motion(tracks), since)) = self.waiting.pop_front() {
                self.pass_lateness_on(&tracks, since);
            }
        }
    }

    /// Appends a copy of a stream message, unless so much waits that it would displace motion.
    pub(super) fn enqueue_copy(&mut self, copy: MessageCopy, since: ServerTime) {
        if self.waiting.len() < DATAGRAM_BACKLOG_MAX / 4 {
            self.enqueue(Body::Copy(copy), since);
        }
    }

    /// Adds the lateness of the oldest skipped news to the next motion of each skipped tool.
    fn pass_lateness_on(&mut self, skipped: &[ToolTrack], since: ServerTime) {
        for track in skipped {
            let next = self
                .waiting
                .iter_mut()
                .find_map(|(body, since)| match body {
                    Body::Motion(tracks) => {
                        let next = tracks
                            .iter_mut()
                            .find(|t| t.participant == track.participant);
                        next.map(|t| (t, *since))
                    }
                    _ => None,
                });
            if let Some((next, next_since)) = next {
                let oldest = track.late.and(next_since - since).oldest;
                next.late.oldest = next.late.oldest.max(oldest);
            }
        }
    }

    /// The next datagram of the send queue, encoded now.
    pub(super) fn pop(&mut self, generated: ServerTime) -> Option<Vec<u8>> {
        while let Some((mut body, since)) = self.waiting.pop_front() {
            if let Body::Motion(tracks) = &mut body {
                let wait = generated - since;
                self.stalls.add(wait.max(Span::ZERO));
                for track in tracks.iter_mut() {
                    track.late = track.late.and(wait);
                }
            }
            if let Some(bytes) = self.encode(body, generated) {
                return Some(bytes);
            }
        }
        None
    }

    /// A datagram of this side. `None`, and counted, where it can not be encoded or the link is
    /// not open.
    pub(super) fn encode(&mut self, body: Body, generated: ServerTime) -> Option<Vec<u8>> {
        match self.encode_whole(body, generated) {
            Ok((_, bytes, _)) => Some(bytes),
            Err(too_large) => self.encode_halves(too_large?, generated),
        }
    }

    /// Encodes a datagram with its number and content; a body that is too large is returned. `None`, and
    /// counted, where it can not be encoded or the link is not open.
    pub(super) fn encode_whole(
        &mut self,
        mut body: Body,
        generated: ServerTime,
    ) -> Result<(u32, Vec<u8>, Body), Option<Body>> {
        let tag = self.tag.ok_or(None)?;
        let left = generated;
        let generated = match &mut body {
            // Its newest sample then needs no time of its own.
            Body::Motion(tracks) => {
                for track in tracks.iter_mut() {
                    track.late = self.claim(track.participant).claim(track.late, generated);
                }
                let newest = tracks.first().and_then(|t| t.samples.last());
                newest.map_or(generated, |s| s.time)
            }
            _ => generated,
        };
        let sequence = self.last_sequence.wrapping_add(1).max(1);
        let is_near = self
            .known_at
            .is_some_and(|t| (generated - t).abs() <= SHORT_TIME);
        let known = self.acknowledged.acknowledgement().map_or(0, |(n, _)| n);
        let is_next = sequence.wrapping_sub(known) <= SHORT_SEQUENCE;
        let datagram = Datagram {
            header: Header {
                tag,
                sequence,
                generated,
                is_whole: !(is_near && is_next),
                acknowledged: self.acknowledgement_due(generated),
            },
            body,
        };
        let bytes = match datagram.encode(&mut self.sent) {
            Ok(bytes) => bytes,
            Err(ProtocolError::TooLarge { .. }) => return Err(Some(datagram.body)),
            Err(_) => {
                self.stats.skipped += 1;
                return Err(None);
            }
        };
        self.last_sequence = sequence;
        if self.sent_at.len() == TIMES_KEPT_MAX {
            self.sent_at.pop_front();
        }
        self.sent_at.push_back(SentAt {
            sequence,
            generated,
            left,
        });
        if datagram.header.acknowledged.is_some() {
            self.unacknowledged = 0;
            self.acknowledged_at = generated;
        }
        self.stats.sent += 1;
        Ok((sequence, bytes, datagram.body))
    }

    /// Sends the first half now and queues the other; an indivisible body is counted.
    fn encode_halves(&mut self, body: Body, generated: ServerTime) -> Option<Vec<u8>> {
        let Some((first, second)) = body.halves() else {
            self.stats.skipped += 1;
            return None;
        };
        // Its lateness is known already.
        self.waiting.push_front((second, generated));
        self.encode(first, generated)
    }

    /// Whether more datagrams have arrived than occasional traffic would acknowledge in time.
    pub(super) fn owes_acknowledgement(&self) -> bool {
        self.unacknowledged >= 2 * ACKNOWLEDGE_EVERY
    }

    fn acknowledgement_due(&self, generated: ServerTime) -> Option<Acknowledgement> {
        let waited = (generated - self.acknowledged_at).abs() >= ACKNOWLEDGE_WITHIN;
        let due = self.unacknowledged >= ACKNOWLEDGE_EVERY || waited;
        let (newest, bits) = self.arrived.acknowledgement()?;
        (due && self.unacknowledged > 0).then_some(Acknowledgement { newest, bits })
    }

    /// The lateness reported for a tool.
    fn claim(&mut self, who: ParticipantId) -> &mut Repeated {
        let at = if let Some(at) = self.claims.iter().position(|(id, _)| *id == who) {
            at
        } else {
            // Bounded, like the tools in a datagram.
            if self.claims.len() == TRACKS_MAX {
                self.claims.remove(0);
            }
            self.claims.push((who, Repeated::default()));
            self.claims.len() - 1
        };
        &mut self.claims[at].1
    }

    pub(super) fn stats(&self) -> LinkStats {
        LinkStats {
            local_stalls: self.stalls.stalls(),
            received: self.arrived.received(),
            expected: self.arrived.expected(),
            acknowledged: self.acknowledged.received(),
            ..self.stats
        }
    }
}
