//! One direction of one flow: the fate of each packet in sequence.

use rand::RngExt;

use super::draw::{Draw, Purpose};
use super::link::Link;
use super::profile::Profile;

/// Maximum delay, ms. It bounds heavy tails and the queue that stores packets.
pub const DELAY_MAX_MS: f64 = 60_000.0;

/// Header bytes per packet on the wire: 20 B of IPv4 and 8 B of UDP.
pub const HEADER_BYTES: usize = 28;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Direction {
    /// From a client to the server.
    Up,
    /// From the server to a client.
    Down,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// Time, microseconds after the start of the network.
    pub at_us: u64,
    pub corrupted: Option<Corruption>,
}

/// One to four flipped bits of a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Corruption {
    random: u64,
}

impl Corruption {
    /// Flips the bits; an empty packet stays empty.
    pub fn apply(self, bytes: &mut [u8]) {
        let bits = bytes.len() as u64 * 8;
        if bits == 0 {
            return;
        }
        // Adjacent bits, as in a burst error, so that flips never cancel.
        let first = (self.random >> 2) % bits;
        for bit in first..(first + 1 + (self.random & 3)).min(bits) {
            bytes[(bit / 8) as usize] ^= 1 << (bit % 8);
        }
    }
}

/// Arrivals of a packet in order: none if it is lost, two if it is duplicated.
pub type Arrivals = Vec<Arrival>;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PathCounts {
    pub sent: u64,
    /// Lost by chance or by the trace.
    pub lost: u64,
    pub in_outage: u64,
    pub queue_full: u64,
    pub duplicated: u64,
    pub corrupted: u64,
}

impl PathCounts {
    pub fn dropped(&self) -> u64 {
        self.lost + self.in_outage + self.queue_full
    }
}

/// One direction of one flow through an emulated network. Pure: equal sends give equal arrivals.
#[derive(Debug, Clone)]
pub struct Path {
    link: Link,
    draw: Draw,
    counts: PathCounts,
    /// Latest time so far; time does not decrease.
    now_us: u64,
    is_bad: bool,
    /// Time until which the bottleneck is busy, in fractional microseconds: at 1 Gbit/s a packet takes ten.
    busy_until_us: f64,
    /// Latest arrival, for networks that keep the order.
    last_arrival_us: u64,
    /// Time of the trace at the start of the network.
    trace_offset_us: u64,
}

impl Path {
    /// Path of a flow in one direction. Packet numbers start with this call.
    pub fn new(profile: &Profile, seed: u64, flow: u64, direction: Direction) -> Self {
        let link = profile.link(direction).clone();
        let trace_offset_us = match (link.trace_offset_s, &link.trace) {
            (Some(s), _) => (s * 1e6).round() as u64,
            // Both directions of a flow were recorded at one time.
            (None, Some(trace)) => Draw::phase(seed, flow) % trace.period_us().max(1),
            (None, None) => 0,
        };
        Self {
            link,
            trace_offset_us,
            draw: Draw::new(seed, flow, direction),
            counts: PathCounts::default(),
            now_us: 0,
            is_bad: false,
            busy_until_us: 0.0,
            last_arrival_us: 0,
        }
    }

    pub fn counts(&self) -> PathCounts {
        self.counts
    }

    /// Sends a packet with `bytes` of payload at a time in microseconds after the start of the network; returns
    /// its arrivals. An earlier time than the last one counts as the last.
    pub fn send(&mut self, at_us: u64, bytes: usize) -> Arrivals {
        self.now_us = self.now_us.max(at_us);
        let n = self.counts.sent;
        self.counts.sent += 1;
        // The state changes with every packet, lost or not.
        let was_bad = self.change_state(n);
        let now_us = self.now_us;
        if self.link.outages.as_ref().is_some_and(|o| o.covers(now_us)) {
            self.counts.in_outage += 1;
            return Arrivals::new();
        }
        let Some(leaves_us) = self.pass_bottleneck(bytes) else {
            self.counts.queue_full += 1;
            return Arrivals::new();
        };
        let trace_us = now_us + self.trace_offset_us;
        let recorded = self.link.trace.as_ref().map(|t| t.at(trace_us));
        let bursts = self.link.bursts.filter(|_| was_bad);
        let loss = bursts.map_or(self.link.loss, |b| b.loss);
        if self.draw.share(n, Purpose::Loss) < loss || recorded.is_some_and(|r| r.lost) {
            self.counts.lost += 1;
            return Arrivals::new();
        }
        let steps = self.link.steps.as_ref();
        let fixed_ms = steps.map_or(self.link.delay_ms, |s| {
            s.delay_ms(now_us, self.link.delay_ms)
        }) + recorded.map_or(0.0, |r| r.delay_ms)
            + bursts.map_or(0.0, |b| b.delay_ms);
        self.arrivals(n, leaves_us, fixed_ms)
    }

    /// State of the link for the `n`-th packet; it may change afterwards.
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

    /// Time at which the last bit of a packet leaves the bottleneck; `None` if its queue is full.
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
            // A duplicate follows its packet directly and does not delay later ones.
            copy_us = copy_us.map(|_| at_us);
        }
        self.last_arrival_us = self.last_arrival_us.max(at_us);
        let first = self.arrival(n, at_us, Purpose::Corrupt);
        let copy = copy_us.map(|at_us| self.arrival(n, at_us, Purpose::CopyCorrupt));
        self.counts.duplicated += u64::from(is_double);
        match copy {
            Some(copy) if copy.at_us < first.at_us => vec![copy, first],
            Some(copy) => vec![first, copy],
            None => vec![first],
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
