//! Statistics of a relay.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::network::PathCounts;

/// Packet counts of all clients, of one direction or of both.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct DirectionStats {
    /// Packets received.
    pub sent: u64,
    /// Packets dropped by the profile: by chance, in an outage, at a full queue.
    pub dropped: u64,
    /// Dropped packets because the link was down.
    pub in_outage: u64,
    /// Dropped packets because the bottleneck queue was full.
    pub queue_full: u64,
    /// Duplicated packets.
    pub duplicated: u64,
    /// Corrupted packets.
    pub corrupted: u64,
    /// Packets sent after one that was received later.
    pub reordered: u64,
}

impl DirectionStats {
    /// Adds the counts of one flow.
    pub(super) fn add(&mut self, counts: PathCounts, reordered: u64) {
        self.sent += counts.sent;
        self.dropped += counts.dropped();
        self.in_outage += counts.in_outage;
        self.queue_full += counts.queue_full;
        self.duplicated += counts.duplicated;
        self.corrupted += counts.corrupted;
        self.reordered += reordered;
    }
}

impl fmt::Display for DirectionStats {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} packets, {} dropped ({} in outages, {} at a full queue), {} doubled, {} corrupted, {} overtaken",
            self.sent,
            self.dropped,
            self.in_outage,
            self.queue_full,
            self.duplicated,
            self.corrupted,
            self.reordered
        )
    }
}

/// Statistics of a relay, both directions together.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RelayStats {
    /// The profile's name.
    pub profile: String,
    /// The seed.
    pub seed: u64,
    /// Clients seen.
    pub clients: u64,
    /// Packet counts of both directions.
    #[serde(flatten)]
    pub total: DirectionStats,
    /// Packets dropped because the relay was full; independent of the profile.
    pub overflowed: u64,
    /// Packets sent, duplicates included.
    pub delivered: u64,
    /// Address changes of clients towards the server.
    #[serde(default)]
    pub rebinds: u64,
    /// Measured delay in the relay, mean, ms.
    pub delay_mean_ms: f64,
    /// Measured delay, median, to 0.1 ms.
    pub delay_p50_ms: f64,
    /// Measured delay, 99th percentile, to 0.1 ms.
    pub delay_p99_ms: f64,
    /// Lateness of packets against their fate, 99th percentile, to 0.1 ms.
    pub lateness_p99_ms: f64,
    /// Measured packet loss, 0 to 1.
    pub loss: f64,
    /// Packets to the server.
    #[serde(default)]
    pub up: DirectionStats,
    /// Packets to clients.
    #[serde(default)]
    pub down: DirectionStats,
}

/// Bucket width, microseconds.
const BUCKET_US: u64 = 100;

/// Number of buckets: up to 2 s; longer times count as 2 s.
const BUCKETS: usize = 20_000;

/// Histogram of times.
#[derive(Debug)]
pub(super) struct Histogram {
    counts: Vec<u32>,
    total: u64,
    sum_us: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            counts: vec![0; BUCKETS],
            total: 0,
            sum_us: 0,
        }
    }
}

impl Histogram {
    pub(super) fn record(&mut self, us: u64) {
        let bucket = ((us / BUCKET_US) as usize).min(BUCKETS - 1);
        self.counts[bucket] = self.counts[bucket].saturating_add(1);
        self.total += 1;
        self.sum_us += us;
    }

    pub(super) fn mean_ms(&self) -> f64 {
        if self.total == 0 {
            0.0
        } else {
            self.sum_us as f64 / self.total as f64 / 1e3
        }
    }

    /// Upper edge of the bucket that contains the quantile `q`.
    pub(super) fn quantile_ms(&self, q: f64) -> f64 {
        if self.total == 0 {
            return 0.0;
        }
        let rank = (q * self.total as f64).ceil() as u64;
        let mut seen = 0;
        let bucket = self.counts.iter().position(|c| {
            seen += u64::from(*c);
            seen >= rank
        });
        (bucket.unwrap_or(BUCKETS - 1) + 1) as f64 * BUCKET_US as f64 / 1e3
    }
}
