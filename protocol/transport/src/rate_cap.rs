//! Rate caps on datagrams, for sending and for receiving.

use std::time::Instant;

use palpate_protocol::{Span, TokenBucket};

/// Bytes per second and connection, 10 Mbit/s: a thousand of the largest datagrams plus an eighth, ten
/// times the rate of a thin subscriber. Datagrams beyond it are skipped. The congestion controller finds
/// the path's capacity.
pub(crate) const RATE_MAX: f64 = 1_250_000.0;

/// Bytes that may go at once: one frame of corrections of a pressed region.
pub(crate) const BURST_MAX: f64 = 64.0 * 1024.0;

/// Bytes per second that one connection accepts. A sender within [`RATE_MAX`] never reaches it; the
/// extra quarter covers clock errors and bunching on the path.
pub(crate) const RECEIVE_RATE_MAX: f64 = 1.25 * RATE_MAX;

/// The largest burst in bytes: datagrams that a path held back for 0.4 s at the full rate. Older ones
/// are useless.
pub(crate) const RECEIVE_BURST_MAX: f64 = 512.0 * 1024.0;

/// The minimum cost of a received datagram, bytes: a tiny one takes nearly the work of a large one. This
/// allows some 3,000 a second, three times the number of the largest within the send cap.
pub(crate) const RECEIVE_COST_MIN: usize = 500;

/// A token bucket of bytes.
#[derive(Debug)]
pub(crate) struct RateCap {
    bucket: TokenBucket,
    cost_min: usize,
    began: Instant,
}

impl RateCap {
    /// A full token bucket for sending.
    pub(crate) fn sending(now: Instant) -> Self {
        Self::new(RATE_MAX, BURST_MAX, 0, now)
    }

    /// A full token bucket for receiving.
    pub(crate) fn receiving(now: Instant) -> Self {
        Self::new(RECEIVE_RATE_MAX, RECEIVE_BURST_MAX, RECEIVE_COST_MIN, now)
    }

    fn new(rate: f64, burst: f64, cost_min: usize, now: Instant) -> Self {
        Self {
            bucket: TokenBucket::new(rate, burst, Span::ZERO),
            cost_min,
            began: now,
        }
    }

    /// Whether `len` bytes may pass now.
    pub(crate) fn take(&mut self, len: usize, now: Instant) -> bool {
        let elapsed = now.saturating_duration_since(self.began).as_micros();
        let elapsed = Span::from_micros(i64::try_from(elapsed).unwrap_or(i64::MAX));
        let cost = len.max(self.cost_min) as f64;
        self.bucket.take(cost, elapsed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// Bytes that pass of datagrams of `len` bytes in one second, one every `every`.
    fn passing(cap: &mut RateCap, start: Instant, len: usize, every: Duration) -> f64 {
        let n = 1_000_000_000 / every.as_nanos() as u32;
        let passed = (0..n).filter(|i| cap.take(len, start + *i * every));
        passed.count() as f64 * len as f64
    }

    #[test]
    fn any_second_carries_at_most_the_rate_and_one_burst() {
        let start = Instant::now();
        let mut cap = RateCap::sending(start);
        let bytes = passing(&mut cap, start, 1100, Duration::from_micros(50));
        assert!(bytes <= RATE_MAX + BURST_MAX);
        assert!(bytes >= RATE_MAX);
    }

    #[test]
    fn sender_at_the_cap_loses_nothing_and_sender_at_twice_the_cap_is_limited() {
        for (times, whole) in [(1.0, true), (2.0, false)] {
            let mut now = Instant::now();
            let mut cap = RateCap::receiving(now);
            let every = Duration::from_secs_f64(1100.0 / (times * RATE_MAX));
            let mut refused = 0;
            for _ in 0..20_000 {
                now += every;
                refused += u32::from(!cap.take(1100, now));
            }
            assert_eq!(refused == 0, whole, "{times} times: {refused}");
        }
    }

    #[test]
    fn tiny_datagrams_are_limited_by_number() {
        let start = Instant::now();
        let mut cap = RateCap::receiving(start);
        let taken = passing(&mut cap, start, 1, Duration::from_micros(10));
        assert!(taken <= (RECEIVE_RATE_MAX + RECEIVE_BURST_MAX) / RECEIVE_COST_MIN as f64);
    }
}
