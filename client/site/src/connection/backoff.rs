//! Jittered exponential back-off: the waits between attempts to reach a server.
//!
//! ```text
//! wait n = min(first * 2^n, 8 s) * u        u uniform in [1/2, 3/2)
//! ```
//!
//! Clients that lost one server, or that it refused in the same moment, would return in the same moment. The jitter
//! spreads them (Metcalfe and Boggs 1976 for Ethernet).

use std::fmt;

use palpate_protocol::{ClientTime, Span};

/// First wait of a client that the server refused for load, without jitter.
pub const BUSY_WAIT_FIRST: Span = Span::from_millis(500);

/// Maximum wait, without jitter.
const WAIT_MAX: Span = Span::from_millis(8000);

/// The waits of one series of attempts.
#[derive(Debug, Clone)]
pub struct Backoff {
    /// The next wait without jitter.
    nominal: Span,
    /// End of the series.
    ends: ClientTime,
    /// State of `SplitMix64` (Steele, Lea and Flood 2014).
    random: u64,
}

impl Backoff {
    /// A series that begins `now` and ends after `patience`. The `seed` of its jitter should differ between clients.
    pub fn new(first: Span, patience: Span, now: ClientTime, seed: u64) -> Self {
        Self {
            nominal: first.min(WAIT_MAX),
            ends: now + patience,
            random: seed,
        }
    }

    /// Whether the series has ended.
    pub fn is_over(&self, now: ClientTime) -> bool {
        now >= self.ends
    }

    /// The wait before the next attempt, at most until the end of the series; `None` once it has ended.
    pub fn wait(&mut self, now: ClientTime) -> Option<Span> {
        if self.is_over(now) {
            return None;
        }
        let nominal_us = self.nominal.as_micros();
        let jitter_us = (nominal_us * i64::from(self.next_random())) >> u32::BITS;
        self.nominal = (self.nominal + self.nominal).min(WAIT_MAX);
        Some(Span::from_micros(nominal_us / 2 + jitter_us).min(self.ends - now))
    }

    fn next_random(&mut self) -> u32 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 32) as u32
    }
}

/// A failed attempt after which another one follows, for the status line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Retry {
    /// Whether the server answered that it has no room.
    pub is_busy: bool,
    /// Cause of the failure.
    pub cause: String,
    /// Wait before the next attempt.
    pub wait: Span,
    /// Number of the next attempt.
    pub attempt: u32,
}

impl fmt::Display for Retry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = if self.is_busy {
            "the server is busy"
        } else {
            "not connected"
        };
        write!(
            f,
            "{state} ({}); trying again in {:.1} s, attempt {}",
            self.cause,
            self.wait.as_secs_f64(),
            self.attempt
        )
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PATIENCE: Span = Span::from_millis(60_000);

    /// The waits of a series in which every attempt fails at once, in µs.
    fn waits(first: Span, seed: u64) -> Vec<i64> {
        let mut now = ClientTime::ZERO;
        let mut backoff = Backoff::new(first, PATIENCE, now, seed);
        let next = || {
            let wait = backoff.wait(now)?;
            now = now + wait;
            Some(wait.as_micros())
        };
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn a_retry_names_cause_wait_and_attempt() {
        let mut retry = Retry {
            is_busy: true,
            cause: "all 8 seats are taken".to_owned(),
            wait: Span::from_millis(1400),
            attempt: 3,
        };
        assert_eq!(
            retry.to_string(),
            "the server is busy (all 8 seats are taken); trying again in 1.4 s, attempt 3"
        );
        retry.is_busy = false;
        assert!(retry.to_string().starts_with("not connected (all"));
    }

    proptest! {
        #[test]
        fn waits_are_bounded_and_fill_the_patience(seed: u64, first_ms in 1_i64..20_000) {
            let waits = waits(Span::from_millis(first_ms), seed);
            let mut nominal = (first_ms * 1000).min(WAIT_MAX.as_micros());
            for (n, wait) in waits.iter().enumerate() {
                // The last wait may end with the patience.
                prop_assert!(*wait >= nominal / 2 || n + 1 == waits.len());
                prop_assert!(*wait > 0 && *wait < nominal * 3 / 2);
                nominal = (2 * nominal).min(WAIT_MAX.as_micros());
            }
            prop_assert_eq!(waits.iter().sum::<i64>(), PATIENCE.as_micros());
        }

        #[test]
        fn waits_grow_until_the_largest(seed: u64) {
            let waits = waits(BUSY_WAIT_FIRST, seed);
            // Nominal waits of 0.5, 1, 2, 4 and 8 s; two doublings exceed the jitter.
            for (earlier, later) in waits[..5].iter().zip(&waits[2..5]) {
                prop_assert!(later > earlier, "{waits:?}");
            }
        }

        #[test]
        fn waits_of_a_crowd_are_spread(base: u64) {
            let first = BUSY_WAIT_FIRST.as_micros();
            let crowd: Vec<i64> = (0..64_u64)
                .map(|n| waits(BUSY_WAIT_FIRST, base.wrapping_add(n))[0])
                .collect();
            for quarter in 0..4 {
                let (from, to) = (first / 2 + quarter * first / 4, first / 2 + (quarter + 1) * first / 4);
                let inside = crowd.iter().filter(|w| (from..to).contains(w)).count();
                prop_assert!((1..=40).contains(&inside), "{inside} of 64 in quarter {quarter}");
            }
        }

        #[test]
        fn equal_seeds_give_equal_waits(seed: u64) {
            prop_assert_eq!(waits(BUSY_WAIT_FIRST, seed), waits(BUSY_WAIT_FIRST, seed));
        }
    }
}
