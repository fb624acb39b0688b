//! The cap on what the application sends as datagrams.

use std::time::Instant;

/// Bytes per second and connection, 10 Mbit/s: a thousand of the largest datagrams with an eighth
/// to spare, ten times what a thin subscriber needs. Beyond it datagrams are skipped. Whether the
/// path takes as much is for the congestion controller to find.
pub(crate) const RATE_MAX: f64 = 1_250_000.0;

/// Bytes that may go at once: one frame of corrections of a pressed region.
pub(crate) const BURST_MAX: f64 = 64.0 * 1024.0;

/// A bucket of bytes that fills with time.
#[derive(Debug)]
pub(crate) struct RateCap {
    bytes: f64,
    filled: Instant,
}

impl RateCap {
    /// A full bucket.
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            bytes: BURST_MAX,
            filled: now,
        }
    }

    /// Whether `len` bytes may go now.
    pub(crate) fn take(&mut self, len: usize, now: Instant) -> bool {
        let elapsed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        self.bytes = (self.bytes + elapsed * RATE_MAX).min(BURST_MAX);
        let fits = self.bytes >= len as f64;
        if fits {
            self.bytes -= len as f64;
        }
        fits
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn no_second_carries_more_than_the_rate_and_one_burst() {
        let start = Instant::now();
        let mut cap = RateCap::new(start);
        let mut bytes = 0;
        for us in 0..1_000_000_u64 / 50 {
            if cap.take(1100, start + Duration::from_micros(us * 50)) {
                bytes += 1100;
            }
        }
        assert!(f64::from(bytes) <= RATE_MAX + BURST_MAX);
        assert!(f64::from(bytes) >= RATE_MAX);
    }
}
