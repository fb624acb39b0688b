//! Timing statistics and event counts of the loop.

use hdrhistogram::Histogram;
use palpate_haptics::Counters;
use palpate_protocol::ClientTime;
use serde::{Deserialize, Serialize};

use super::hand_loop::DeviceCounts;

/// Upper bound of the histograms, µs; longer times count as this.
const MAX_US: u64 = 10_000_000;

/// Percentiles of lateness, µs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lateness {
    /// Median.
    pub p50: u64,
    /// 99th percentile.
    pub p99: u64,
    /// 99.9th percentile.
    pub p999: u64,
    /// Maximum.
    pub max: u64,
}

impl Lateness {
    fn of(h: &Histogram<u32>) -> Self {
        let q = |quantile| h.value_at_quantile(quantile);
        Self {
            p50: q(0.5),
            p99: q(0.99),
            p999: q(0.999),
            max: h.max(),
        }
    }
}

/// Statistics of the loop so far.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopStats {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks per second since the loop began, Hz.
    pub rate_hz: f64,
    /// Delay of ticks after their deadlines, µs.
    pub lateness_us: Lateness,
    /// Deadlines that were skipped.
    pub missed: u64,
    /// The force of the last tick, N.
    pub force_n: f64,
    /// Counters of the chain, including its largest force change per tick.
    pub counters: Counters,
    /// Events of the device.
    pub device: DeviceCounts,
    /// Frames dropped because the ring to the network was full.
    pub frames_dropped: u64,
}

/// Collects statistics. Allocates on creation only.
pub(super) struct Meter {
    began: ClientTime,
    lateness: Histogram<u32>,
    pub(super) stats: LoopStats,
}

impl Meter {
    pub(super) fn new(began: ClientTime) -> Self {
        Self {
            began,
            lateness: Histogram::new_with_bounds(1, MAX_US, 3)
                .expect("1 to 10^7 in 3 digits is a valid range"),
            stats: LoopStats::default(),
        }
    }

    /// Records a tick that began at `woke`.
    pub(super) fn record(&mut self, deadline: ClientTime, woke: ClientTime) {
        let late = (woke - deadline).as_micros().max(0);
        self.lateness.saturating_record(late as u64);
        self.stats.ticks += 1;
    }

    /// The statistics as of `now`. It takes a few microseconds: call it a few times a second.
    pub(super) fn snapshot(&mut self, now: ClientTime, missed: u64) -> LoopStats {
        let seconds = (now - self.began).as_secs_f64();
        self.stats.rate_hz = if seconds > 0.0 {
            self.stats.ticks as f64 / seconds
        } else {
            0.0
        };
        self.stats.lateness_us = Lateness::of(&self.lateness);
        self.stats.missed = missed;
        self.stats
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::ClientTime;

    use super::Meter;

    #[test]
    fn percentiles_match_recorded_times() {
        let at = ClientTime::from_micros;
        let mut meter = Meter::new(at(0));
        for i in 0..1000 {
            let due = i * 1000;
            let late = if i == 999 { 50_000_000 } else { i % 10 };
            meter.record(at(due), at(due + late));
        }
        let s = meter.snapshot(at(1_000_000), 7);
        assert_eq!((s.ticks, s.missed, s.rate_hz), (1000, 7, 1000.0));
        assert_eq!((s.lateness_us.p50, s.lateness_us.p99), (4, 9));
        assert!(s.lateness_us.max >= 10_000_000 && s.lateness_us.max < 10_100_000);
    }
}
