//! Lateness that machines cause, separated from the lateness that networks cause.
//!
//! ```text
//! sender    takes samples, and sends them after at most a batch       the rest is lateness of the sender
//! server    receives them, and relays them after at most a round      the rest is lateness of the server
//! receiver  handles what its socket holds as soon as it is there      the rest is a stall of the receiver
//! ```
//!
//! Every track carries the lateness of its sender and of the server ([`Lateness`], in the datagram). The
//! receiver's part is measured where the socket is read ([`StallDetector`]). The playout delay covers the
//! rest: the network.

use crate::{ServerTime, Span};

/// Largest lateness that a datagram can report. Older motion is not sent.
pub const LATENESS_MAX: Span = Span::from_millis(2000);

/// Resolution of reported lateness on the wire, rounded down.
pub const LATENESS_STEP: Span = Span::from_millis(1);

/// Reported lateness of the oldest news is repeated for this long, so that it survives a lost datagram.
const REPEAT: Span = Span::from_millis(100);

/// The lateness of a track's samples that machines caused, beyond regular batches and rounds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Lateness {
    /// Lateness of the newest sample.
    pub newest: Span,
    /// Lateness of the oldest news: how much later than regular the first sample after the track before was
    /// sent. It is at least that of the newest sample.
    pub oldest: Span,
}

impl Lateness {
    /// A track that machines did not delay.
    pub const NONE: Self = Self {
        newest: Span::ZERO,
        oldest: Span::ZERO,
    };

    /// Lateness at `now` of a track of which the newest sample and the oldest news are due at these moments.
    pub fn after<T: Copy + std::ops::Sub<Output = Span>>(now: T, newest: T, oldest: T) -> Self {
        let newest = (now - newest).max(Span::ZERO);
        Self {
            newest,
            oldest: (now - oldest).max(newest),
        }
        .limited()
    }

    /// The same track after another `wait`.
    #[must_use]
    pub fn and(self, wait: Span) -> Self {
        let wait = wait.max(Span::ZERO);
        Self {
            newest: self.newest + wait,
            oldest: self.oldest + wait,
        }
        .limited()
    }

    /// The value that a datagram carries: within limits, in whole steps.
    #[must_use]
    pub fn limited(self) -> Self {
        let step = LATENESS_STEP.as_micros();
        let limit = |s: Span| {
            let us = s.clamp(Span::ZERO, LATENESS_MAX).as_micros();
            Span::from_micros(us / step * step)
        };
        let newest = limit(self.newest);
        Self {
            newest,
            oldest: limit(self.oldest).max(newest),
        }
    }
}

/// Repeats a sender's reported lateness about the oldest news of one track.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Repeated {
    until: ServerTime,
    oldest: Span,
}

impl Repeated {
    /// The reported lateness of a track that leaves now.
    pub(crate) fn claim(&mut self, late: Lateness, now: ServerTime) -> Lateness {
        // A clock that was set back leaves the end far ahead.
        let is_over = now >= self.until || self.until - now > REPEAT;
        if late.oldest >= self.oldest || is_over {
            *self = Self {
                until: now + REPEAT,
                oldest: late.oldest,
            };
        }
        Lateness {
            oldest: self.oldest.max(late.newest),
            ..late
        }
    }
}

/// A timer that fires later than this was delayed by the machine: timers have a resolution of 1 ms.
const TIMER_TOLERANCE: Span = Span::from_millis(2);

/// The longest sleep while something moves. It is twice the period of motion, so that the timer seldom fires in a
/// session that runs smoothly.
const WATCH_PERIOD: Span = Span::from_millis(8);

/// Something moves when the receiver is woken twice within this time.
const MOTION_GAP: Span = Span::from_millis(20);

/// The receiver keeps watching for this long after motion: a sender may have stalled.
const WATCH_AFTER: Span = Span::from_millis(500);

/// After a stall the datagrams in the socket's queue pass through other tasks of this machine. The queue
/// takes up to the stall divided by this to drain.
const SETTLING_PART: i64 = 4;

/// Measures how long datagrams may have waited for a stalled receiver.
///
/// Calling order, with one monotonic clock: [`waits`](Self::waits) before the receiver waits,
/// [`wake`](Self::wake) when it continues, [`handle_datagram`](Self::handle_datagram) for every datagram, and
/// [`handle_empty`](Self::handle_empty) when no datagram is left.
///
/// A running receiver wakes at its deadline at the latest. Past the deadline it was stalled, and a
/// datagram in its queue may have arrived at any time since the queue was last empty.
#[derive(Debug, Clone, Copy, Default)]
pub struct StallDetector {
    /// When the queue was last seen empty.
    empty_at: Span,
    deadline: Option<Span>,
    stalled: Option<Stall>,
    /// When it was last woken before its deadline.
    woken_at: Option<Span>,
    watch_until: Span,
}

/// A stall of the receiver.
#[derive(Debug, Clone, Copy)]
struct Stall {
    /// The queue was empty then.
    began: Span,
    /// The queue has drained by then.
    settled_at: Span,
}

impl StallDetector {
    /// The receiver sleeps from `now` on, for at most `wait`; returns how long it may sleep.
    pub fn waits(&mut self, now: Span, wait: Span) -> Span {
        let wait = if now < self.watch_until {
            wait.min(WATCH_PERIOD)
        } else {
            wait
        };
        self.deadline = Some(now + wait);
        wait
    }

    /// The receiver continues.
    pub fn wake(&mut self, now: Span) {
        let Some(deadline) = self.deadline.take() else {
            return;
        };
        if now < deadline {
            if self.woken_at.is_some_and(|at| now - at <= MOTION_GAP) {
                self.watch_until = now + WATCH_AFTER;
            }
            self.woken_at = Some(now);
        }
        if now > deadline + TIMER_TOLERANCE {
            let length = (now - self.empty_at).as_micros();
            self.stalled = Some(Stall {
                began: self.empty_at,
                settled_at: now + Span::from_micros(length / SETTLING_PART),
            });
        }
    }

    /// Notes a datagram taken from the queue; returns how long it may have waited there because of a
    /// stall.
    pub fn handle_datagram(&self, now: Span) -> Span {
        self.stalled.map_or(Span::ZERO, |stall| now - stall.began)
    }

    /// No datagram is left in the queue.
    pub fn handle_empty(&mut self, now: Span) {
        self.empty_at = now;
        if self.stalled.is_some_and(|stall| now >= stall.settled_at) {
            self.stalled = None;
        }
    }
}

/// Lateness that this machine caused, of datagrams received and of motion sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LocalStalls {
    /// The 99th percentile, to 10 %.
    pub p99: Span,
    /// The largest.
    pub max: Span,
    /// How many were later than 20 ms.
    pub above_20_ms: u64,
    /// How many were measured.
    pub count: u64,
}

/// Lateness up to this counts as none.
const NO_STALL: Span = Span::from_millis(1);

/// [`LocalStalls::above_20_ms`] counts longer stalls. A datagram that waited this long does not measure
/// a clock.
pub(crate) const LONG_STALL: Span = Span::from_millis(20);

/// Classes of a [`StallCounter`], eight for every doubling.
const CLASSES: usize = 96;
const CLASSES_PER_OCTAVE: f64 = 8.0;

/// Counts stalls by length: the first class is up to [`NO_STALL`], each next class is a tenth wider.
#[derive(Debug, Clone)]
pub(crate) struct StallCounter {
    classes: [u64; CLASSES],
    max: Span,
    above_20_ms: u64,
    count: u64,
}

impl Default for StallCounter {
    fn default() -> Self {
        Self {
            classes: [0; CLASSES],
            max: Span::ZERO,
            above_20_ms: 0,
            count: 0,
        }
    }
}

impl StallCounter {
    pub(crate) fn add(&mut self, stall: Span) {
        let ratio = stall.as_micros() as f64 / NO_STALL.as_micros() as f64;
        // Class k ends at 2^(k/8) ms.
        let class = if ratio <= 1.0 {
            0
        } else {
            ((CLASSES_PER_OCTAVE * ratio.log2()).ceil() as usize).min(CLASSES - 1)
        };
        self.classes[class] += 1;
        self.max = self.max.max(stall);
        self.above_20_ms += u64::from(stall > LONG_STALL);
        self.count += 1;
    }

    pub(crate) fn stalls(&self) -> LocalStalls {
        let mut left = self.count.div_ceil(100);
        let class = self.classes.iter().rposition(|n| {
            left = left.saturating_sub(*n);
            left == 0
        });
        let p99 = match class {
            None | Some(0) => Span::ZERO,
            Some(class) => {
                let ratio = (class as f64 / CLASSES_PER_OCTAVE).exp2();
                Span::from_micros((NO_STALL.as_micros() as f64 * ratio) as i64).min(self.max)
            }
        };
        LocalStalls {
            p99,
            max: self.max,
            above_20_ms: self.above_20_ms,
            count: self.count,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn ms(ms: i64) -> Span {
        Span::from_millis(ms)
    }

    #[test]
    fn running_receiver_sees_no_stall_during_network_silence() {
        let mut watch = StallDetector::default();
        let mut now = Span::ZERO;
        for silence in [4, 4, 4, 300, 4, 4, 2000, 4] {
            // The timer fires until a datagram arrives.
            let until = now + ms(silence);
            loop {
                let wait = watch.waits(now, ms(100));
                let arrives = until <= now + wait;
                now = if arrives { until } else { now + wait + ms(1) };
                watch.wake(now);
                if arrives {
                    assert_eq!(watch.handle_datagram(now), Span::ZERO);
                }
                watch.handle_empty(now);
                if now >= until {
                    break;
                }
            }
        }
    }

    #[test]
    fn stall_counts_for_queued_datagrams_only() {
        let mut watch = StallDetector::default();
        for t in [0, 4, 8, 12] {
            watch.waits(ms(t - 4), ms(100));
            watch.wake(ms(t));
            watch.handle_datagram(ms(t));
            watch.handle_empty(ms(t));
        }
        assert_eq!(watch.waits(ms(12), ms(100)), WATCH_PERIOD);
        watch.wake(ms(250));
        assert_eq!(watch.handle_datagram(ms(250)), ms(238));
        // The receiver is busy elsewhere before the queue is empty.
        watch.waits(ms(251), Span::ZERO);
        watch.wake(ms(251));
        assert_eq!(watch.handle_datagram(ms(251)), ms(239));
        // The socket is read by another task, which runs after this one.
        watch.handle_empty(ms(251));
        watch.waits(ms(251), ms(100));
        watch.wake(ms(255));
        assert_eq!(watch.handle_datagram(ms(255)), ms(243));
        watch.handle_empty(ms(310));
        watch.waits(ms(310), ms(100));
        watch.wake(ms(315));
        assert_eq!(watch.handle_datagram(ms(315)), Span::ZERO);
    }

    #[test]
    fn stall_of_a_late_receiver_is_at_most_its_sleep() {
        let mut watch = StallDetector::default();
        for t in (0..10_000_i64).step_by(30) {
            watch.wake(ms(t));
            assert!(watch.handle_datagram(ms(t)) <= ms(30));
            watch.handle_empty(ms(t));
            watch.waits(ms(t), ms(10));
        }
    }

    #[test]
    fn reported_lateness_is_repeated_to_survive_a_loss() {
        let mut repeated = Repeated::default();
        let at = |t: i64| ServerTime::from_micros(t * 1000);
        let late = |t| Lateness {
            newest: Span::ZERO,
            oldest: ms(t),
        };
        assert_eq!(repeated.claim(late(0), at(0)), late(0));
        assert_eq!(repeated.claim(late(200), at(200)), late(200));
        assert_eq!(repeated.claim(late(3), at(204)), late(200));
        assert_eq!(repeated.claim(late(0), at(299)), late(200));
        assert_eq!(repeated.claim(late(0), at(300)), late(0));
    }

    #[test]
    fn the_99th_percentile_is_within_a_tenth_and_the_largest_exact() {
        let mut counter = StallCounter::default();
        assert_eq!(counter.stalls(), LocalStalls::default());
        for i in 1..=1000_i64 {
            counter.add(Span::from_micros(100 * i));
        }
        let stalls = counter.stalls();
        let p99 = stalls.p99.as_millis_f64();
        assert!(
            (99.0..=109.0).contains(&p99) || stalls.p99 == stalls.max,
            "{p99}"
        );
        assert_eq!(
            (stalls.max, stalls.above_20_ms, stalls.count),
            (ms(100), 800, 1000)
        );
        let mut quiet = StallCounter::default();
        (0..995).for_each(|_| quiet.add(Span::ZERO));
        (0..5).for_each(|_| quiet.add(ms(300)));
        assert_eq!(
            (quiet.stalls().p99, quiet.stalls().max),
            (Span::ZERO, ms(300))
        );
    }

    proptest! {
        #[test]
        fn reported_lateness_is_within_its_limits_for_any_input(
            newest in any::<i32>(), oldest in any::<i32>(), wait in any::<i32>(),
        ) {
            let us = |us: i32| Span::from_micros(i64::from(us));
            let late = Lateness { newest: us(newest), oldest: us(oldest) }.limited().and(us(wait));
            for part in [late.newest, late.oldest] {
                prop_assert!((Span::ZERO..=LATENESS_MAX).contains(&part));
                prop_assert_eq!(part.as_micros() % LATENESS_STEP.as_micros(), 0);
            }
            prop_assert!(late.oldest >= late.newest);
        }
    }
}
