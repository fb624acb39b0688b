//! Statistics of a relay.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::network::PathCounts;

/// Packet counts of all clients, of one direction or of both.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct DirectionStats {
    pub sent: u64,
    /// Packets dropped by the profile: by chance, in an outage, at a full queue.
    pub dropped: u64,
    pub in_outage: u64,
    pub queue_full: u64,
    pub duplicated: u64,
    pub corrupted: u64,
    /// Packets sent after one that was received later.
    pub reordered: u64,
}

impl DirectionStats {
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

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RelayStats {
    pub profile: String,
    pub seed: u64,
    pub clients: u64,
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
    pub delay_p99_ms: f64,
    /// Lateness of packets against their fate, 99th percentile, to 0.1 ms.
    pub lateness_p99_ms: f64,
    pub loss: f64,
    #[serde(default)]
    pub up: DirectionStats,
    #[serde(default)]
    pub down: DirectionStats,
}
