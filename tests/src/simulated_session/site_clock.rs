//! The local clock of a site in relation to true time.

use palpate_protocol::ClientTime;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Maximum drift of a quartz clock, parts per million.
const DRIFT_PPM: f64 = 50.0;

/// Maximum offset between two machines' monotonic clocks, s; each counts from its boot.
const OFFSET_S: f64 = 1e6;

#[derive(Debug, Clone, Copy)]
pub(crate) struct SiteClock {
    offset_us: i64,
    rate: f64,
}

impl SiteClock {
    /// A clock that shows `offset_us` at true time 0 and gains `drift` seconds per second.
    pub(crate) fn new(offset_us: i64, drift: f64) -> Self {
        Self {
            offset_us,
            rate: 1.0 + drift,
        }
    }

    pub(crate) fn of(seed: u64, seat: usize) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed ^ (seat as u64 + 1).wrapping_mul(0x9e37_79b9));
        let offset_us = (rng.random_range(0.0..OFFSET_S) * 1e6) as i64;
        Self::new(offset_us, rng.random_range(-DRIFT_PPM..DRIFT_PPM) * 1e-6)
    }

    pub(crate) fn step(&mut self, by_us: i64) {
        self.offset_us += by_us;
    }

    /// The local time at a true time in µs.
    pub(crate) fn at(&self, true_us: i64) -> ClientTime {
        let ran = (true_us as f64 * self.rate).round() as i64;
        ClientTime::from_micros(self.offset_us + ran)
    }

    /// The true time in µs at which the local clock shows `t`.
    pub(crate) fn true_us(&self, t: ClientTime) -> i64 {
        ((t.as_micros() - self.offset_us) as f64 / self.rate).round() as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn true_time_survives_round_trip_through_local_time() {
        for seat in 0..20 {
            let clock = SiteClock::of(7, seat);
            for us in [0, 1, 999_999, 3_600_000_000] {
                assert!((clock.true_us(clock.at(us)) - us).abs() <= 1);
            }
        }
    }
}
