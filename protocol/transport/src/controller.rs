//! How many bytes may be on the way: a congestion controller for a thin, steady stream.
//!
//! Motion is some ten kilobytes a second that are worth nothing when late. A controller that
//! halves its window for every lost packet makes such a stream wait behind its own caution (one
//! second of delay at 5 % loss, measured with Cubic). Here the window W is
//!
//! ```text
//! W = max(W_floor, W_reno)                      while the path is well
//! W = W_floor · (1/2)^k, at least W_min         while the delay shows a queue:  r > 2 r_min + 100 ms
//! W = W_min                                     while the breaker is open: 40 % of 2 s of bytes lost
//! ```
//!
//! where k grows by one per round trip with a queue and shrinks by one per round trip without. The
//! floor alone would be unfair: it stands together with a cap on what the application may send
//! ([`RateCap`]), with the back-off and with the breaker, so that a path that is truly too narrow is
//! left to others.

use std::any::Any;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quinn::congestion::{Controller, ControllerFactory};
use quinn_proto::RttEstimator;

/// `W_floor` in bytes: a round trip of 600 ms carries 200 kB/s, four times what a tool needs.
const WINDOW_FLOOR: u64 = 128 * 1024;

/// `W_min` in bytes: still 25 kB/s at 600 ms, enough for heartbeats and operations.
const WINDOW_MIN: u64 = 16 * 1024;

/// The largest window in bytes; what is larger is for the bulk connection.
const WINDOW_MAX: u64 = 1024 * 1024;

/// Queueing delay that is nobody's fault: schedulers, radio, jitter.
const QUEUE_ALLOWED: Duration = Duration::from_millis(100);

/// The breaker looks at this much time at once, and stays open as long.
const BREAKER_PERIOD: Duration = Duration::from_secs(2);

/// The share of bytes lost in a period that opens the breaker.
const BREAKER_LOSS: f64 = 0.4;

/// A period with fewer bytes than this says nothing.
const BREAKER_MIN_BYTES: u64 = 32 * 1024;

/// Halvings of the floor at most: down to `WINDOW_MIN`.
const BACK_OFF_MAX: u32 = 3;

/// Makes the controllers.
#[derive(Debug, Default)]
pub(crate) struct FloorConfig;

impl ControllerFactory for FloorConfig {
    fn build(self: Arc<Self>, now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Floor::new(now, current_mtu))
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
    /// k, and when it last changed.
    back_off: u32,
    back_off_since: Instant,
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
        self.period_since = now;
        self.acked_bytes = 0;
        self.lost_bytes = 0;
    }

    fn watch_delay(&mut self, now: Instant, smoothed: Duration, min: Duration) {
        if now.saturating_duration_since(self.back_off_since) < smoothed {
            return;
        }
        self.back_off_since = now;
        if smoothed > 2 * min + QUEUE_ALLOWED {
            self.back_off = (self.back_off + 1).min(BACK_OFF_MAX);
            self.reno = WINDOW_MIN;
        } else {
            self.back_off = self.back_off.saturating_sub(1);
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
        self.watch_delay(now, rtt.get(), rtt.min());
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
