//! A token bucket (Turner 1986): a rate with a burst, in virtual time.

use palpate_protocol::ServerTime;

/// Tokens that refill at a constant rate up to a capacity. Charges after the fact may leave a debt.
#[derive(Debug, Clone)]
pub(crate) struct Bucket {
    capacity: f64,
    per_s: f64,
    level: f64,
    at: ServerTime,
}

impl Bucket {
    /// A bucket with `level` tokens at `now`.
    pub(crate) fn new(capacity: f64, per_s: f64, level: f64, now: ServerTime) -> Self {
        Self {
            capacity,
            per_s,
            level: level.min(capacity),
            at: now,
        }
    }

    /// The tokens at `now`; negative in debt.
    pub(crate) fn level(&mut self, now: ServerTime) -> f64 {
        let elapsed = (now - self.at).as_secs_f64().max(0.0);
        self.at = self.at.max(now);
        self.level = (self.level + elapsed * self.per_s).min(self.capacity);
        self.level
    }

    /// Takes tokens if there are enough.
    pub(crate) fn take(&mut self, tokens: f64, now: ServerTime) -> bool {
        let enough = self.level(now) >= tokens;
        if enough {
            self.level -= tokens;
        }
        enough
    }

    /// Takes tokens for something that is done already.
    pub(crate) fn charge(&mut self, tokens: f64, now: ServerTime) {
        self.level(now);
        self.level -= tokens;
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn taken_tokens_never_exceed_burst_plus_rate(
            steps in prop::collection::vec((0_i64..5_000_000, 0.0..20.0_f64), 1..200),
        ) {
            let mut now = ServerTime::ZERO;
            let mut bucket = Bucket::new(10.0, 2.0, 10.0, now);
            let mut taken = 0.0;
            for (wait, tokens) in steps {
                now = now + Span::from_micros(wait);
                if bucket.take(tokens, now) {
                    taken += tokens;
                }
                let limit = 10.0 + 2.0 * (now - ServerTime::ZERO).as_secs_f64();
                prop_assert!(taken <= limit + 1e-9);
            }
        }
    }

    #[test]
    fn debt_is_paid_over_time() {
        let at = |s: i64| ServerTime::from_micros(s * 1_000_000);
        let mut bucket = Bucket::new(2.0, 0.5, 2.0, at(0));
        bucket.charge(5.0, at(0));
        assert!(!bucket.take(0.0, at(5)));
        assert!(bucket.take(0.0, at(6)));
        // A clock that steps back gives nothing.
        assert!(!bucket.take(0.5, at(1)));
    }
}
