//! A token bucket: the rate limit of requests, datagrams and connection attempts.

use crate::Span;

/// Fills with `rate` tokens a second up to `burst`, and is full at first. Times are spans since any fixed
/// moment; a time before the newest one counts as the newest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenBucket {
    rate: f64,
    burst: f64,
    tokens: f64,
    filled: Span,
}

impl TokenBucket {
    /// A full bucket; `rate` in tokens per second, `burst` in tokens.
    pub const fn new(rate: f64, burst: f64, now: Span) -> Self {
        Self {
            rate,
            burst,
            tokens: burst,
            filled: now,
        }
    }

    /// The same bucket with fewer tokens at first.
    #[must_use]
    pub const fn holding(mut self, tokens: f64) -> Self {
        self.tokens = tokens;
        self
    }

    /// Takes `cost` tokens for something that is done already; the bucket may be in debt afterwards.
    pub fn charge(&mut self, cost: f64, now: Span) {
        self.tokens = self.level(now) - cost;
        self.filled = self.filled.max(now);
    }

    /// Takes `cost` tokens; `false` if the bucket holds fewer, and then takes none.
    pub fn take(&mut self, cost: f64, now: Span) -> bool {
        self.tokens = self.level(now);
        self.filled = self.filled.max(now);
        let fits = self.tokens >= cost;
        if fits {
            self.tokens -= cost;
        }
        fits
    }

    /// Whether `cost` tokens could be taken.
    pub fn has(&self, cost: f64, now: Span) -> bool {
        self.level(now) >= cost
    }

    /// Whether the bucket is as full as a new one.
    pub fn is_full(&self, now: Span) -> bool {
        self.has(self.burst, now)
    }

    fn level(&self, now: Span) -> f64 {
        let elapsed = (now - self.filled).max(Span::ZERO);
        (self.tokens + elapsed.as_secs_f64() * self.rate).min(self.burst)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn any_interval_passes_at_most_its_rate_and_one_burst(
            rate in 1.0..1000.0_f64,
            burst in 1.0..1000.0_f64,
            waits_us in prop::collection::vec(-1000..100_000_i64, 1..300),
        ) {
            let mut bucket = TokenBucket::new(rate, burst, Span::ZERO);
            let (mut now, mut newest, mut passed) = (Span::ZERO, Span::ZERO, 0.0);
            for us in waits_us {
                now += Span::from_micros(us);
                newest = newest.max(now);
                let had = bucket.has(1.0, now);
                let taken = bucket.take(1.0, now);
                prop_assert_eq!(had, taken);
                passed += f64::from(u8::from(taken));
                prop_assert!(passed <= burst + newest.as_secs_f64() * rate + 1e-6);
            }
        }

        #[test]
        fn sender_at_the_rate_is_never_limited(rate in 1_u32..1000, burst in 2_u32..100) {
            let mut bucket = TokenBucket::new(f64::from(rate), f64::from(burst), Span::ZERO);
            for i in 1..500_i64 {
                // Rounded up, so that the sender is never above the rate.
                let now = Span::from_micros((i * 1_000_000 + i64::from(rate) - 1) / i64::from(rate));
                prop_assert!(bucket.take(1.0, now));
            }
        }
    }

    #[test]
    fn debt_is_paid_over_time() {
        let at = |s: i64| Span::from_millis(s * 1000);
        let mut bucket = TokenBucket::new(0.5, 2.0, at(0)).holding(1.0);
        bucket.charge(4.0, at(0));
        assert!(!bucket.take(0.0, at(5)));
        assert!(bucket.take(0.0, at(6)));
        // A clock that steps back gives nothing.
        assert!(!bucket.take(0.5, at(1)));
    }

    #[test]
    fn unused_bucket_is_full_again_after_burst_over_rate() {
        let mut bucket = TokenBucket::new(10.0, 5.0, Span::ZERO);
        assert!(bucket.take(5.0, Span::ZERO) && !bucket.is_full(Span::from_millis(499)));
        assert!(bucket.is_full(Span::from_millis(500)));
    }
}
