//! Congestion controller for a thin, steady stream.
//!
//! Motion is some ten kilobytes a second and worthless when late. A controller that halves its window
//! for every lost packet delays such a stream by its own caution (one second of delay at 5 % loss,
//! measured with Cubic). Here the window W is
//!
//! ```text
//! W = max(W_floor, W_reno)                      without congestion, k = 0
//! W = W_floor · (1/2)^k, at least W_min         after k congested rounds
//! W = W_min                                     while the breaker is open: 40 % of 2 s of bytes lost
//! ```
//!
//! A round is a round trip, at least [`ROUND_MIN`]. Its queueing delay q is `r_low` - `r_base`: the
//! shortest round trip in it minus the shortest of the last minute. The minimum is used because jitter
//! delays some packets and a queue delays all of them. A round increments k where
//!
//! ```text
//! q > 15 ms and a packet was lost        an overflowing queue: loss by cross traffic and this stream
//! q > r_base + 100 ms                    a queue so deep that it does not even overflow
//! l > 10 %                               heavy loss without any queue, over 2 s
//! ```
//!
//! and k decrements after two seconds without a queue, or later where returning failed. Loss alone below
//! 10 % is the path's own (radio) and changes nothing, or motion would be delayed by caution again. The
//! heavy-loss rule covers a stream that started with the queue already full and has no base delay.
//!
//! The floor alone would be unfair. The cap on the application's rate ([`RateCap`]), the back-off and
//! the breaker leave a path that is too narrow to other traffic. Measured with two sessions at the cap
//! and one Cubic flow on 10 Mbit/s with 64 KiB of queue: the Cubic flow gets 0.44 to 0.69 of it, each
//! session 0.14 to 0.35. (With the floor alone the Cubic flow got 0.03.)
//!
//! The rule is a reconstruction: loss counts as congestion only with a backlog, after Veno (Fu and Liew
//! 2003); yielding to delay, after LEDBAT (RFC 6817).
//!
//! [`RateCap`]: crate::rate_cap::RateCap

use std::any::Any;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quinn::congestion::{Controller, ControllerFactory};
use quinn_proto::RttEstimator;

/// `W_floor` in bytes: a round trip of 600 ms carries 200 kB/s, four times what a tool needs.
const WINDOW_FLOOR: u64 = 128 * 1024;

/// `W_min` in bytes: still 25 kB/s at 600 ms, enough for heartbeats and operations.
const WINDOW_MIN: u64 = 16 * 1024;

/// The largest window in bytes; larger transfers use the bulk connection.
const WINDOW_MAX: u64 = 1024 * 1024;

/// Queueing delay that is not attributed to congestion without loss: schedulers, radio, a longer route.
const QUEUE_ALLOWED: Duration = Duration::from_millis(100);

/// Queueing delay that shows, together with loss, that a queue overflows. 16 KiB at 10 Mbit/s take
/// 13 ms; jitter of ±20 ms moves the shortest of a round by less.
const QUEUE_SHOWN: Duration = Duration::from_millis(15);

/// Below this delay the queue counts as empty, and the floor returns.
const QUEUE_GONE: Duration = Duration::from_millis(10);

/// How long a loss counts, besides a round trip: it is detected later than the queue that caused it.
const LOSS_REMEMBERED: Duration = Duration::from_millis(200);

/// The shortest round: 25 packets of a tool, enough for one without jitter.
const ROUND_MIN: Duration = Duration::from_millis(100);

/// Acknowledged packets without which a round is not over, for the same reason.
const ROUND_MIN_PACKETS: u32 = 8;

/// The floor returns by one doubling in this time. A faster return would fill the queue
/// again and again.
const RETURN: Duration = Duration::from_secs(2);

/// ... and each failed return doubles the wait for the next one, up to this. A return fails when the
/// floor must be reduced again within [`RETURN_FAILED`].
const RETURN_MAX: Duration = Duration::from_secs(16);

/// See [`RETURN_MAX`].
const RETURN_FAILED: Duration = Duration::from_secs(6);

/// `r_base` is the shortest round trip of the last one to two of these periods. Until then, a longer
/// route looks like a queue.
const BASE_PERIOD: Duration = Duration::from_secs(30);

/// The breaker looks at this much time at once, and stays open as long.
const BREAKER_PERIOD: Duration = Duration::from_secs(2);

/// The share of bytes lost in a period that opens the breaker.
const BREAKER_LOSS: f64 = 0.4;

/// The share of bytes lost in a period that increments k: twice the loss that motion must tolerate.
const LOSS_HEAVY: f64 = 0.1;

/// A period with fewer bytes than this is not evaluated.
const BREAKER_MIN_BYTES: u64 = 32 * 1024;

/// Largest number of halvings of the floor: down to `WINDOW_MIN`.
const BACK_OFF_MAX: u32 = 3;

/// The factory of the controllers.
#[derive(Debug, Default)]
pub(crate) struct FloorConfig;

impl ControllerFactory for FloorConfig {
    fn build(self: Arc<Self>, now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Floor::new(now, current_mtu))
    }
}

/// The round trips of one round.
#[derive(Debug, Clone)]
struct Round {
    since: Instant,
    low: Duration,
    packets: u32,
}

impl Round {
    fn new(since: Instant) -> Self {
        Self {
            since,
            low: Duration::MAX,
            packets: 0,
        }
    }
}

/// The shortest round trip of this period and of the one before.
#[derive(Debug, Clone)]
struct Base {
    since: Instant,
    low: Duration,
    before: Duration,
}

impl Base {
    fn new(since: Instant) -> Self {
        Self {
            since,
            low: Duration::MAX,
            before: Duration::MAX,
        }
    }

    fn learn(&mut self, rtt: Duration, now: Instant) {
        if now.saturating_duration_since(self.since) >= BASE_PERIOD {
            self.before = self.low;
            self.low = rtt;
            self.since = now;
        }
        self.low = self.low.min(rtt);
    }

    fn get(&self) -> Duration {
        self.low.min(self.before)
    }
}

/// See the file's derivation.
#[derive(Debug, Clone)]
struct Floor {
    mtu: u64,
    /// `W_reno`.
    reno: u64,
    threshold: u64,
    recovery_since: Instant,
    /// k, and when it last grew or was seen to be needed.
    back_off: u32,
    back_off_since: Instant,
    /// The current wait before the floor returns (initially two seconds), and the time of the last
    /// return.
    return_after: Duration,
    returned_at: Option<Instant>,
    round: Round,
    base: Base,
    lost_at: Option<Instant>,
    period_since: Instant,
    acked_bytes: u64,
    lost_bytes: u64,
    open_until: Option<Instant>,
}

impl Floor {
    fn new(now: Instant, mtu: u16) -> Self {
        Self {
            mtu: u64::from(mtu),
            reno: WINDOW_FLOOR,
            threshold: WINDOW_MAX,
            recovery_since: now,
            back_off: 0,
            back_off_since: now,
            return_after: RETURN,
            returned_at: None,
            round: Round::new(now),
            base: Base::new(now),
            lost_at: None,
            period_since: now,
            acked_bytes: 0,
            lost_bytes: 0,
            open_until: None,
        }
    }

    /// Ends a period of the breaker, if it is over.
    fn judge(&mut self, now: Instant) {
        if now.saturating_duration_since(self.period_since) < BREAKER_PERIOD {
            return;
        }
        let total = self.acked_bytes + self.lost_bytes;
        let too_much = self.lost_bytes as f64 > BREAKER_LOSS * total as f64;
        let known = total >= BREAKER_MIN_BYTES;
        if too_much && known {
            self.open_until = Some(now + BREAKER_PERIOD);
        } else if self.open_until.is_some_and(|until| now >= until) {
            self.open_until = None;
        }
        if known && self.lost_bytes as f64 > LOSS_HEAVY * total as f64 {
            self.give_way(now);
        }
        self.period_since = now;
        self.acked_bytes = 0;
        self.lost_bytes = 0;
    }

    fn give_way(&mut self, now: Instant) {
        if let Some(returned) = self.returned_at.take() {
            let failed = now.saturating_duration_since(returned) < RETURN_FAILED;
            self.return_after = if failed {
                (2 * self.return_after).min(RETURN_MAX)
            } else {
                RETURN
            };
        }
        self.back_off = (self.back_off + 1).min(BACK_OFF_MAX);
        self.back_off_since = now;
        self.reno = WINDOW_MIN;
        self.threshold = WINDOW_FLOOR;
    }

    /// Takes one round trip time, and ends the round if it is over.
    fn watch_delay(&mut self, now: Instant, rtt: Duration, smoothed: Duration) {
        self.base.learn(rtt, now);
        self.round.low = self.round.low.min(rtt);
        self.round.packets += 1;
        let length = now.saturating_duration_since(self.round.since);
        if length < smoothed.max(ROUND_MIN) || self.round.packets < ROUND_MIN_PACKETS {
            return;
        }
        let base = self.base.get();
        let queue = self.round.low.saturating_sub(base);
        self.round = Round::new(now);
        let lost = self
            .lost_at
            .is_some_and(|at| now.saturating_duration_since(at) < smoothed + LOSS_REMEMBERED);
        if (queue > QUEUE_SHOWN && lost) || queue > base + QUEUE_ALLOWED {
            self.give_way(now);
        } else if queue > QUEUE_GONE {
            // The cross traffic is still there; the window stays reduced.
            self.back_off_since = now;
        } else if now.saturating_duration_since(self.back_off_since) >= self.return_after {
            if self.back_off > 0 {
                self.back_off -= 1;
                self.returned_at = Some(now);
            }
            self.back_off_since = now;
        }
    }
}

impl Controller for Floor {
    fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        app_limited: bool,
        rtt: &RttEstimator,
    ) {
        self.acked_bytes += bytes;
        self.judge(now);
        self.watch_delay(now, now.saturating_duration_since(sent), rtt.get());
        if app_limited || sent <= self.recovery_since || self.back_off > 0 {
            return;
        }
        let growth = if self.reno < self.threshold {
            bytes
        } else {
            self.mtu * bytes / self.reno
        };
        self.reno = (self.reno + growth).min(WINDOW_MAX);
    }

    fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        is_persistent_congestion: bool,
        lost_bytes: u64,
    ) {
        self.lost_bytes += lost_bytes;
        self.lost_at = Some(now);
        self.judge(now);
        if is_persistent_congestion {
            self.open_until = Some(now + BREAKER_PERIOD);
        }
        if sent > self.recovery_since {
            self.recovery_since = now;
            self.reno = (self.reno / 2).max(WINDOW_MIN);
            self.threshold = self.reno;
        }
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.mtu = u64::from(new_mtu);
    }

    fn window(&self) -> u64 {
        if self.open_until.is_some() {
            return WINDOW_MIN;
        }
        let floor = (WINDOW_FLOOR >> self.back_off).max(WINDOW_MIN);
        if self.back_off > 0 {
            floor
        } else {
            floor.max(self.reno)
        }
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        WINDOW_FLOOR
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half a second of 250 packets a second with these round trips, every `lost_one_in`th lost.
    fn half_a_second(
        floor: &mut Floor,
        now: &mut Instant,
        rtt: impl Fn(u64) -> Duration,
        lost_one_in: u64,
    ) {
        for i in 1..=125 {
            *now += Duration::from_millis(4);
            if lost_one_in > 0 && i % lost_one_in == 0 {
                floor.on_congestion_event(*now, *now, false, 1100);
            }
            floor.acked_bytes += 1100;
            floor.watch_delay(*now, rtt(i), Duration::from_millis(50));
        }
    }

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn loss_without_a_queue_keeps_the_floor_under_any_jitter() {
        let mut now = Instant::now();
        let mut floor = Floor::new(now, 1200);
        for _ in 0..20 {
            half_a_second(&mut floor, &mut now, |i| ms(50 + i * 7 % 40), 14);
            assert!(floor.window() >= WINDOW_FLOOR);
        }
    }

    #[test]
    fn delay_without_loss_keeps_the_floor() {
        let mut now = Instant::now();
        let mut floor = Floor::new(now, 1200);
        for rtt in [60, 160, 120, 60] {
            half_a_second(&mut floor, &mut now, |_| ms(rtt), 0);
            assert!(floor.window() >= WINDOW_FLOOR);
        }
    }

    #[test]
    fn overflowing_queue_removes_the_floor_until_it_drains() {
        let mut now = Instant::now();
        let mut floor = Floor::new(now, 1200);
        half_a_second(&mut floor, &mut now, |_| ms(50), 0);
        half_a_second(&mut floor, &mut now, |_| ms(90), 20);
        assert_eq!(floor.window(), WINDOW_MIN);
        // The cross traffic's queue is still there, if not overflowing.
        for _ in 0..20 {
            half_a_second(&mut floor, &mut now, |_| ms(70), 0);
            assert_eq!(floor.window(), WINDOW_MIN);
        }
        for _ in 0..14 {
            half_a_second(&mut floor, &mut now, |_| ms(51), 0);
        }
        assert!(floor.window() >= WINDOW_FLOOR);
    }

    #[test]
    fn deep_queue_removes_the_floor_without_loss() {
        let mut now = Instant::now();
        let mut floor = Floor::new(now, 1200);
        half_a_second(&mut floor, &mut now, |_| ms(50), 0);
        half_a_second(&mut floor, &mut now, |_| ms(260), 0);
        assert_eq!(floor.window(), WINDOW_MIN);
    }

    #[test]
    fn longer_route_is_recognised_after_a_minute() {
        let mut now = Instant::now();
        let mut floor = Floor::new(now, 1200);
        half_a_second(&mut floor, &mut now, |_| ms(50), 0);
        for _ in 0..140 {
            half_a_second(&mut floor, &mut now, |_| ms(260), 20);
        }
        assert!(floor.window() >= WINDOW_FLOOR);
    }
}
