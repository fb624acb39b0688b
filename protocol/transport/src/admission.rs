//! Admission of connections that have not joined yet: which attempts the server answers, and for how long.
//!
//! A connection is pending from its first packet until the room accepts its hello, or until its request for
//! a model has named a participant of the session. A full table evicts instead of refusing, as a SYN cache
//! does (Lemon 2002): the oldest connection of the address with the most pending ones ends. An address with
//! one pending connection therefore loses it only while no address has two.
//!
//! [`Admission`] is a pure state machine: times are spans since the server began, and the shell
//! ([`Slots`](crate::slots::Slots)) holds the connections.

use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, Ipv6Addr};

use palpate_protocol::session::HANDSHAKE_TIMEOUT;
use palpate_protocol::{Span, TokenBucket};

/// Pending connections. A full class of [`ROSTER_MAX`](palpate_protocol::handshake::ROSTER_MAX) with a
/// session and a transfer each takes half of them.
pub(crate) const PENDING_MAX: usize = 256;

/// From this number of pending connections on, an address must prove that it is real (QUIC Retry) before
/// the server does any work for it. The proof costs a newcomer one round trip; without pressure it is
/// not asked.
const RETRY_FROM: usize = 8;

/// Attempts per second and address, and their burst: some 6 % of a core (0.3 ms for a key exchange, a
/// signature and the packets), and three full classes behind one router.
const ADDRESS_RATE: f64 = 200.0;

/// Attempts per second of all addresses, and their burst: some 30 % of a core.
const TOTAL_RATE: f64 = 1000.0;

/// Addresses in the table. Only those are kept that have a pending connection or a bucket that is not
/// full. Within a second, in which any bucket fills, at most 2,000 attempts pass, so the table always has
/// room.
const ADDRESSES_MAX: usize = 4096;

/// The longest QUIC handshake: several lost packets in a row with doubling waits.
const HANDSHAKE_MAX: Span = Span::from_millis(10_000);

/// The longest time from the handshake to the end of the first message, which a client sends at once: it
/// arrives later only after three losses in a row (0.8 % of joins at 20 % loss).
const OPENING_MAX: Span = Span::from_millis(2000);

/// The identity of a connection in the table; later ones are larger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Ticket(u64);

/// The answer to an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Ask for a proof of the address.
    Retry,
    /// Drop without an answer: the client's retransmission is the back-off.
    Ignore,
    /// Accept, and close the evicted connection.
    Admit {
        ticket: Ticket,
        evicted: Option<Ticket>,
    },
}

/// How far a pending connection has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Handshake,
    /// The first message is awaited.
    Opening,
    /// The hello is complete and the room decides.
    Decision,
}

impl Stage {
    const fn time_max(self) -> Span {
        match self {
            Self::Handshake => HANDSHAKE_MAX,
            Self::Opening => OPENING_MAX,
            Self::Decision => HANDSHAKE_TIMEOUT,
        }
    }
}

#[derive(Debug)]
struct Pending {
    address: IpAddr,
    stage: Stage,
    since: Span,
}

/// An address and its connections.
#[derive(Debug)]
struct Origin {
    pending: usize,
    bucket: TokenBucket,
}

/// Counters of connections that did not join, since the server began.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AdmissionStats {
    /// Attempts that were asked to prove their address.
    pub retried: u64,
    /// Attempts beyond the rate of their address or of all addresses; they got no answer.
    pub dropped: u64,
    /// Unfinished connections that gave way to newer ones.
    pub evicted: u64,
    /// Connections without a complete handshake or first message within the time limit.
    pub timed_out: u64,
    /// Requests for a model by others than participants, or for another model.
    pub transfers_refused: u64,
}

/// The table of pending connections; see the file's documentation.
#[derive(Debug)]
pub(crate) struct Admission {
    /// In the order of their attempts.
    pending: BTreeMap<Ticket, Pending>,
    origins: HashMap<IpAddr, Origin>,
    total: TokenBucket,
    next: u64,
    stats: AdmissionStats,
}

impl Admission {
    pub(crate) fn new(now: Span) -> Self {
        Self {
            pending: BTreeMap::new(),
            origins: HashMap::new(),
            total: TokenBucket::new(TOTAL_RATE, TOTAL_RATE, now),
            next: 0,
            stats: AdmissionStats::default(),
        }
    }

    /// An attempt of an address, which has or has not proved that it is real.
    pub(crate) fn handle_attempt(&mut self, from: IpAddr, is_proved: bool, now: Span) -> Verdict {
        // An address that is not real must not use up anything of a real one.
        if !is_proved && self.pending.len() >= RETRY_FROM {
            self.stats.retried += 1;
            return Verdict::Retry;
        }
        let address = prefix(from);
        if !self.take_tokens(address, now) {
            self.stats.dropped += 1;
            return Verdict::Ignore;
        }
        let ticket = Ticket(self.next);
        self.next += 1;
        let pending = Pending {
            address,
            stage: Stage::Handshake,
            since: now,
        };
        self.pending.insert(ticket, pending);
        let evicted = (self.pending.len() > PENDING_MAX)
            .then(|| self.victim())
            .flatten();
        if let Some(evicted) = evicted {
            self.finish(evicted);
            self.stats.evicted += 1;
        }
        Verdict::Admit { ticket, evicted }
    }

    /// Takes a token of the address and one of all addresses, and counts the connection for the address.
    fn take_tokens(&mut self, address: IpAddr, now: Span) -> bool {
        let is_known = self.origins.get(&address);
        if is_known.is_some_and(|origin| !origin.bucket.has(1.0, now)) {
            return false;
        }
        if is_known.is_none() && self.origins.len() >= ADDRESSES_MAX {
            self.origins
                .retain(|_, origin| origin.pending > 0 || !origin.bucket.is_full(now));
            if self.origins.len() >= ADDRESSES_MAX {
                return false;
            }
        }
        if !self.total.take(1.0, now) {
            return false;
        }
        let origin = self.origins.entry(address).or_insert_with(|| Origin {
            pending: 0,
            bucket: TokenBucket::new(ADDRESS_RATE, ADDRESS_RATE, now),
        });
        origin.pending += 1;
        origin.bucket.take(1.0, now)
    }

    /// The oldest connection among those of the addresses with the most.
    fn victim(&self) -> Option<Ticket> {
        let mut victim = (0, None);
        for (ticket, pending) in &self.pending {
            let crowd = self.origins.get(&pending.address).map_or(0, |o| o.pending);
            if crowd > victim.0 {
                victim = (crowd, Some(*ticket));
            }
        }
        victim.1
    }

    /// The handshake is complete; `false` if the connection has been evicted.
    pub(crate) fn handle_handshake(&mut self, ticket: Ticket, now: Span) -> bool {
        self.enter(ticket, Stage::Opening, now)
    }

    /// The hello is complete, and the room has it.
    pub(crate) fn handle_hello(&mut self, ticket: Ticket, now: Span) {
        self.enter(ticket, Stage::Decision, now);
    }

    fn enter(&mut self, ticket: Ticket, stage: Stage, now: Span) -> bool {
        let Some(pending) = self.pending.get_mut(&ticket) else {
            return false;
        };
        (pending.stage, pending.since) = (stage, now);
        true
    }

    /// The connection is accepted or over.
    pub(crate) fn finish(&mut self, ticket: Ticket) {
        if let Some(gone) = self.pending.remove(&ticket)
            && let Some(origin) = self.origins.get_mut(&gone.address)
        {
            origin.pending -= 1;
        }
    }

    /// Counts a refused request for a model.
    pub(crate) fn count_refused_transfer(&mut self) {
        self.stats.transfers_refused += 1;
    }

    /// The connections that have exceeded the time of their stage: the shell closes them.
    pub(crate) fn handle_timeout(&mut self, now: Span) -> Vec<Ticket> {
        let is_over = |p: &Pending| now - p.since >= p.stage.time_max();
        let over: Vec<Ticket> = self
            .pending
            .iter()
            .filter(|(_, p)| is_over(p))
            .map(|(t, _)| *t)
            .collect();
        for ticket in &over {
            self.finish(*ticket);
        }
        self.stats.timed_out += over.len() as u64;
        over
    }

    pub(crate) fn stats(&self) -> AdmissionStats {
        self.stats
    }
}

/// The part of an address that one owner holds: all of IPv4, the first 64 bits of IPv6.
fn prefix(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(v4) => v4.into(),
        IpAddr::V6(v6) => Ipv6Addr::from_bits(v6.to_bits() >> 64 << 64).into(),
    }
}

#[cfg(test)]
mod tests;
