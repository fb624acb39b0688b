//! How well the loop keeps its time, and what it met.

use hdrhistogram::Histogram;
use palpate_haptics::Counters;
use palpate_protocol::{ClientTime, Span};

use super::hand_loop::DeviceCounts;

/// The longest lateness or computing time that is told apart, µs; longer ones count as this.
const MAX_US: u64 = 10_000_000;

/// Percentiles of a time, µs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Percentiles {
    /// Half of the ticks were below.
    pub p50: u64,
    /// 99 of 100 were below.
    pub p99: u64,
    /// 999 of 1000 were below.
    pub p999: u64,
    /// The largest.
    pub max: u64,
}

impl Percentiles {
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

/// The loop so far.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LoopStats {
    /// Ticks done.
    pub ticks: u64,
    /// Seconds since the loop began.
    pub seconds: f64,
    /// Ticks per second since the loop began, Hz.
    pub rate_hz: f64,
    /// How long after its deadline a tick began, µs.
    pub lateness_us: Percentiles,
    /// How long a tick took: reading, computing, writing, handing over, µs.
    pub work_us: Percentiles,
    /// Deadlines that were skipped.
    pub missed: u64,
    /// The force of the last tick, N.
    pub force_n: f64,
    /// What the chain met; its largest change of force per tick among it.
    pub counters: Counters,
    /// What the device did beside rendering.
    pub device: DeviceCounts,
    /// Frames that found the ring to the network full and were dropped.
    pub frames_dropped: u64,
}

/// Collects the figures of the loop. Allocates when it is made and never after.
pub(super) struct Meter {
    began: ClientTime,
    lateness: Histogram<u32>,
    work: Histogram<u32>,
    pub(super) stats: LoopStats,
}

impl Meter {
    pub(super) fn new(began: ClientTime) -> Self {
        let histogram = || {
            Histogram::new_with_bounds(1, MAX_US, 3)
                .expect("1 to 10^7 in 3 digits is a valid range")
        };
        Self {
            began,
            lateness: histogram(),
            work: histogram(),
            stats: LoopStats::default(),
        }
    }

    /// A tick that was due at `deadline`, began at `woke` and ended at `done`.
    pub(super) fn record(&mut self, deadline: ClientTime, woke: ClientTime, done: ClientTime) {
        self.lateness.saturating_record(micros(woke - deadline));
        self.work.saturating_record(micros(done - woke));
        self.stats.ticks += 1;
    }

    /// The figures as of `now`. A few microseconds of computing: call it a few times a second.
    pub(super) fn snapshot(&mut self, now: ClientTime, missed: u64) -> LoopStats {
        let seconds = (now - self.began).as_secs_f64();
        self.stats.seconds = seconds;
        self.stats.rate_hz = if seconds > 0.0 {
            self.stats.ticks as f64 / seconds
        } else {
            0.0
        };
        self.stats.lateness_us = Percentiles::of(&self.lateness);
        self.stats.work_us = Percentiles::of(&self.work);
        self.stats.missed = missed;
        self.stats
    }

    /// The histograms of lateness and of computing time, µs.
    pub(super) fn into_histograms(self) -> (Histogram<u32>, Histogram<u32>) {
        (self.lateness, self.work)
    }
}

fn micros(span: Span) -> u64 {
    span.as_micros().max(0) as u64
}

#[cfg(test)]
mod tests {
    use palpate_protocol::ClientTime;

    use super::Meter;

    #[test]
    fn percentiles_are_those_of_what_was_recorded() {
        let at = ClientTime::from_micros;
        let mut meter = Meter::new(at(0));
        for i in 0..1000 {
            let due = i * 1000;
            let late = if i == 999 { 50_000_000 } else { i % 10 };
            meter.record(at(due), at(due + late), at(due + late + 20));
        }
        let s = meter.snapshot(at(1_000_000), 7);
        assert_eq!((s.ticks, s.missed, s.rate_hz), (1000, 7, 1000.0));
        assert_eq!((s.lateness_us.p50, s.lateness_us.p99), (4, 9));
        assert_eq!((s.work_us.p50, s.work_us.max), (20, 20));
        assert!(s.lateness_us.max >= 10_000_000 && s.lateness_us.max < 10_100_000);
    }
}
