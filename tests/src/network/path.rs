//! One direction of one flow: what becomes of its packets, one after the other.

use rand::RngExt;

use super::draw::{Draw, Purpose};
use super::link::Link;
use super::profile::Profile;

/// The longest delay, milliseconds. A heavy tail has no end of its own; a packet of a minute ago
/// is lost to everybody, and a queue that keeps it is not short.
pub const DELAY_MAX_MS: f64 = 60_000.0;

/// What a packet has on the wire beside its payload: 20 B of IPv4 and 8 B of UDP.
pub const HEADER_BYTES: usize = 28;

/// Which way a packet goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Direction {
    /// From a client to the server.
    Up,
    /// From the server to a client.
    Down,
}

/// One arrival of a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// When, microseconds after the network began.
    pub at_us: u64,
    /// What happened to its bits.
    pub corrupted: Option<Corruption>,
}

/// Flipped bits: one to four of a packet's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Corruption {
    random: u64,
}

impl Corruption {
    /// Flips the bits; in an empty packet there are none.
    pub fn apply(self, bytes: &mut [u8]) {
        let bits = bytes.len() as u64 * 8;
        if bits == 0 {
            return;
        }
        // Neighbours, as a disturbed moment makes them, so that they never undo each other.
        let first = (self.random >> 2) % bits;
        for bit in first..(first + 1 + (self.random & 3)).min(bits) {
            bytes[(bit / 8) as usize] ^= 1 << (bit % 8);
        }
    }
}

/// The arrivals of a packet, the earlier first: none when it is lost, two when it is doubled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Arrivals([Option<Arrival>; 2]);

impl Arrivals {
    /// The arrivals.
    pub fn iter(&self) -> impl Iterator<Item = &Arrival> {
        self.0.iter().flatten()
    }

    /// How many: 0, 1 or 2.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether the packet is lost.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl IntoIterator for Arrivals {
    type Item = Arrival;
    type IntoIter = std::iter::Flatten<std::array::IntoIter<Option<Arrival>, 2>>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.into_iter().flatten()
    }
}

/// What became of a path's packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PathCounts {
    /// Packets sent.
    pub sent: u64,
    /// Lost by chance or by the trace.
    pub lost: u64,
    /// Lost because the link was down.
    pub in_outage: u64,
    /// Lost because the bottleneck's queue was full.
    pub queue_full: u64,
    /// Arrived twice.
    pub duplicated: u64,
    /// Arrivals with flipped bits.
    pub corrupted: u64,
}

impl PathCounts {
    /// Packets that never arrived.
    pub fn dropped(&self) -> u64 {
        self.lost + self.in_outage + self.queue_full
    }
}

/// One direction of one flow through an emulated network. Pure: the same sends get the same
/// arrivals.
#[derive(Debug, Clone)]
pub struct Path {
    link: Link,
    draw: Draw,
    counts: PathCounts,
    /// The latest time so far; time does not go back.
    now_us: u64,
    /// Whether the link of two states is in its bad one.
    is_bad: bool,
    /// Until when the bottleneck has work, microseconds; in parts of them, because at 1 Gbit/s a
    /// packet takes ten.
    busy_until_us: f64,
    /// The latest arrival, for networks that keep the order.
    last_arrival_us: u64,
}

impl Path {
    /// The path of a flow's packets in one direction. Packets count from this call on.
    pub fn new(profile: &Profile, seed: u64, flow: u64, direction: Direction) -> Self {
        Self {
            link: profile.link(direction).clone(),
            draw: Draw::new(seed, flow, direction),
            counts: PathCounts::default(),
            now_us: 0,
            is_bad: false,
            busy_until_us: 0.0,
            last_arrival_us: 0,
        }
    }

    /// What became of the packets so far.
    pub fn counts(&self) -> PathCounts {
        self.counts
    }

    /// Sends a packet with `bytes` of payload at a time in microseconds after the network began,
    /// and says when it arrives. A time before the last one counts as the last.
    pub fn send(&mut self, at_us: u64, bytes: usize) -> Arrivals {
        self.now_us = self.now_us.max(at_us);
        let n = self.counts.sent;
        self.counts.sent += 1;
        // The state changes with every packet, whatever else becomes of it.
        let was_bad = self.change_state(n);
        let at_s = self.now_us as f64 * 1e-6;
        if self.link.outages.as_ref().is_some_and(|o| o.covers(at_s)) {
            self.counts.in_outage += 1;
            return Arrivals::default();
        }
        let Some(leaves_us) = self.pass_bottleneck(bytes) else {
            self.counts.queue_full += 1;
            return Arrivals::default();
        };
        let recorded = self.link.trace.as_ref().map(|t| t.at(at_s * 1e3));
        let bursts = self.link.bursts.filter(|_| was_bad);
        let loss = bursts.map_or(self.link.loss, |b| b.loss);
        if self.draw.share(n, Purpose::Loss) < loss || recorded.is_some_and(|r| r.lost) {
            self.counts.lost += 1;
            return Arrivals::default();
        }
        let steps = self.link.steps.as_ref();
        let fixed_ms = steps.map_or(self.link.delay_ms, |s| s.delay_ms(at_s, self.link.delay_ms))
            + recorded.map_or(0.0, |r| r.delay_ms)
            + bursts.map_or(0.0, |b| b.delay_ms);
        self.arrivals(n, leaves_us, fixed_ms)
    }

    /// Whether the state is bad for the `n`-th packet; afterwards it may change.
    fn change_state(&mut self, n: u64) -> bool {
        let was_bad = self.is_bad;
        if let Some(bursts) = self.link.bursts {
            let mean = if was_bad {
                bursts.bad_packets
            } else {
                bursts.good_packets
            };
            self.is_bad ^= self.draw.share(n, Purpose::State) * mean < 1.0;
        }
        was_bad
    }

    /// When the last bit of a packet has left the bottleneck, or nothing when its queue is full.
    fn pass_bottleneck(&mut self, bytes: usize) -> Option<f64> {
        let now_us = self.now_us as f64;
        let Some(rate) = self.link.rate else {
            return Some(now_us);
        };
        let us_per_byte = 8e6 / rate.bits_per_s;
        let bytes = (bytes + HEADER_BYTES) as f64;
        let waiting = (self.busy_until_us - now_us).max(0.0) / us_per_byte;
        if waiting + bytes > rate.queue_bytes as f64 {
            return None;
        }
        self.busy_until_us = self.busy_until_us.max(now_us) + bytes * us_per_byte;
        Some(self.busy_until_us)
    }

    /// The arrivals of a packet that is not lost.
    fn arrivals(&mut self, n: u64, leaves_us: f64, fixed_ms: f64) -> Arrivals {
        let arrives_us = |purpose| {
            let jitter_ms = self.link.jitter.draw_ms(&mut self.draw.stream(n, purpose));
            let delay_ms = (fixed_ms + jitter_ms).clamp(0.0, DELAY_MAX_MS);
            (leaves_us + delay_ms * 1e3).round() as u64
        };
        let mut at_us = arrives_us(Purpose::Delay);
        let is_double = self.draw.share(n, Purpose::Duplicate) < self.link.duplicate;
        let mut copy_us = is_double.then(|| arrives_us(Purpose::CopyDelay));
        if !self.link.reorder {
            at_us = at_us.max(self.last_arrival_us);
            // Right behind the packet: a copy must not hold up those that follow.
            copy_us = copy_us.map(|_| at_us);
        }
        self.last_arrival_us = self.last_arrival_us.max(at_us);
        let first = self.arrival(n, at_us, Purpose::Corrupt);
        let copy = copy_us.map(|at_us| self.arrival(n, at_us, Purpose::CopyCorrupt));
        self.counts.duplicated += u64::from(is_double);
        match copy {
            Some(copy) if copy.at_us < first.at_us => Arrivals([Some(copy), Some(first)]),
            copy => Arrivals([Some(first), copy]),
        }
    }

    fn arrival(&mut self, n: u64, at_us: u64, purpose: Purpose) -> Arrival {
        let mut rng = self.draw.stream(n, purpose);
        let happens = rng.random::<f64>() < self.link.corrupt;
        self.counts.corrupted += u64::from(happens);
        Arrival {
            at_us,
            corrupted: happens.then(|| Corruption {
                random: rng.random(),
            }),
        }
    }
}
