//! The delay estimate: the distance of the displayed moment from the newest sample, over time.
//!
//! A packet's age is the age of a sample on arrival. Until the next one arrives the newest sample grows
//! older. At every moment t the site requires the delay
//!
//! ```text
//! n(t) = t - (moment of the newest sample here)
//! ```
//!
//! With D >= n nothing is extrapolated; with D < n the timeline extrapolates by n - D beyond its newest
//! sample. A few milliseconds of extrapolation are nearly free (`verlet`: 0.02 mm rms at 10 ms), so that
//! D need not cover all of n: it is aimed up to [`BRIDGE`] below the [`SHARE`] of n.
//!
//! ```text
//! D* = max( q(n over LONG or SHORT, the smaller) - BRIDGE,  required delay of a burst )
//! ```
//!
//! Three memories, because paths change in three ways (the rule is our own):
//! - A **step up** shows in a few packets that are all beyond the bridge of D: the memory before them is
//!   cleared.
//! - A **step down** shows when the short memory lies below the long one.
//! - A **burst** is a step up that reverts within [`BURST_MAX`]. A single burst is forgotten after
//!   [`BURST_MEMORY_LEAST`]. The delay of recurring bursts is kept from one to the next, without the
//!   bridge, because packets are missing within a burst too.
//!
//! The bridge covers jitter. A path without jitter gets none, and keeps the whole bridge for a change.

use std::collections::VecDeque;

use super::estimator::MotionArrival;
use crate::{ServerTime, Span};

/// The longest extrapolation beyond the newest sample that the rule plans for at the edge of its
/// `SHARE`.
pub const BRIDGE: Span = Span::from_millis(12);

/// The bridge of a short path, where the bridge is most of the delay.
const BRIDGE_SHORT: Span = Span::from_micros(11_300);

/// A path counts as short up to the first delay and as long from the second on, with a linear blend
/// between.
const SHORT_PATH: [Span; 2] = [Span::from_millis(15), Span::from_millis(30)];

/// The bridge in multiples of the jitter spread (from the median to the [`SHARE`]).
const BRIDGE_SPREADS: i64 = 3;

/// The spread of the required delay on a path without jitter: from the median to the [`SHARE`] of a packet interval of 4 ms.
const PACKET_SPREAD_US: i64 = 1840;

/// The share of the time that D and the bridge together are to cover.
const SHARE: f64 = 0.96;

/// The long memory: enough packets for a steady quantile of jitter.
const LONG: Span = Span::from_millis(4000);

/// The short memory: its distance below the long one is a step down.
const SHORT: Span = Span::from_millis(700);

/// Consecutive packets, all later than the bridge covers, that make a step up.
const STEP_PACKETS: usize = 3;

/// The distance of all [`STEP_PACKETS`] above the long memory's quantile that makes a step up.
const STEP_US: i64 = 6000;

/// A longer rise is the new state of the path, not a burst.
const BURST_MAX: Span = Span::from_millis(1200);

/// How long a single burst is remembered.
const BURST_MEMORY_LEAST: Span = Span::from_millis(2000);

/// Recurring bursts are remembered for this multiple of the longest time between two of them.
const BURST_MEMORY_GAPS: i64 = 3;

/// Bursts farther apart than this do not recur.
const BURST_MEMORY_MOST: Span = Span::from_millis(30_000);

/// The margin above the required delay of a burst: about every second burst is a little worse than the one before.
const BURST_MARGIN_US: i64 = 5000;

/// Intervals remembered. At 250 Hz the long memory needs 1000; a faster stream is remembered for a
/// shorter time.
const INTERVALS_MAX: usize = 2048;

/// The minimum weight of an interval: packets that arrive together have no time between them.
const INTERVAL_MIN_US: i64 = 1;

/// The bridge of a path with this required delay and spread, microseconds.
fn bridge(required_us: i64, spread_us: i64) -> i64 {
    let [short, long] = SHORT_PATH.map(Span::as_micros);
    let part = (long - required_us).clamp(0, long - short);
    let least = BRIDGE_SHORT.as_micros() * part / (long - short);
    (BRIDGE_SPREADS * (spread_us - PACKET_SPREAD_US)).clamp(least, BRIDGE.as_micros())
}

/// The delay estimate from one packet to the next: from the age of the first on its arrival up to that
/// age plus the time between them.
#[derive(Debug, Clone, Copy)]
struct Interval {
    until: ServerTime,
    from_us: i64,
    to_us: i64,
}

/// A rise of the required delay that may be a burst.
#[derive(Debug, Clone, Copy)]
struct Rise {
    began: ServerTime,
    before_us: i64,
    peak_us: i64,
}

/// The bursts of a path.
#[derive(Debug, Clone, Copy)]
struct Bursts {
    /// When the last one ended.
    ended: ServerTime,
    /// How long they are remembered.
    memory: Span,
    /// Their largest required delay, while it is remembered.
    required_us: Option<i64>,
}

impl Bursts {
    /// A burst ended, with this required delay.
    fn note(before: Option<Self>, required_us: i64, now: ServerTime) -> Self {
        let recurring = before.filter(|b| now - b.ended <= BURST_MEMORY_MOST);
        let Some(before) = recurring else {
            return Self {
                ended: now,
                memory: BURST_MEMORY_LEAST,
                required_us: Some(required_us),
            };
        };
        let gap = Span::from_micros(BURST_MEMORY_GAPS * (now - before.ended).as_micros());
        Self {
            ended: now,
            memory: before.memory.max(gap).min(BURST_MEMORY_MOST),
            required_us: before.required_us.max(Some(required_us)),
        }
    }

    /// Forgets expired bursts.
    fn forget(&mut self, now: ServerTime) {
        if now - self.ended > self.memory {
            self.required_us = None;
        }
    }
}

/// The D that a site needs so that the timeline can bridge the rest.
#[derive(Debug, Clone, Default)]
pub(super) struct BridgedDelay {
    /// The newest sample and its age on arrival.
    newest: Option<(ServerTime, Span)>,
    last_arrival: ServerTime,
    intervals: VecDeque<Interval>,
    settled_us: Option<i64>,
    bridge_us: i64,
    rise: Option<Rise>,
    bursts: Option<Bursts>,
    since_sorted: u32,
}

impl BridgedDelay {
    /// Notes motion whose newest sample had this age on arrival, after the lateness of its sender and
    /// server, `taken_off`, was subtracted. Returns `true` when the path has just become slower: report
    /// at once.
    pub(super) fn handle_arrival(
        &mut self,
        motion: &MotionArrival,
        taken_off: Span,
        age: Span,
    ) -> bool {
        let (generated, arrival) = (motion.generated, motion.arrived);
        let Some((newest, age_before)) = self.newest else {
            self.newest = Some((generated, age));
            self.last_arrival = arrival;
            return false;
        };
        if generated <= newest {
            return false;
        }
        // The required delay just before its arrival, had its oldest news left in time.
        let oldest = generated - newest + taken_off - motion.late.oldest + age;
        let interval = Interval {
            until: arrival,
            from_us: age_before.as_micros(),
            to_us: oldest.max(age).max(age_before).as_micros(),
        };
        // A silent tool needs no delay.
        let silent = arrival - self.last_arrival > LONG || generated - newest > LONG;
        self.newest = Some((generated, age));
        self.last_arrival = self.last_arrival.max(arrival);
        if silent {
            return false;
        }
        self.remember(interval);
        let stepped = self.note_step(arrival);
        self.note_burst(arrival);
        // Quantiles over a thousand intervals for every packet would be wasted.
        self.since_sorted += 1;
        if stepped || self.since_sorted >= 8 || self.settled_us.is_none() {
            self.since_sorted = 0;
            self.settled_us = Some(self.settle(arrival));
        }
        stepped
    }

    fn remember(&mut self, interval: Interval) {
        let now = interval.until;
        while self.intervals.len() == INTERVALS_MAX
            || self.intervals.front().is_some_and(|i| now - i.until > LONG)
        {
            self.intervals.pop_front();
        }
        self.intervals.push_back(interval);
    }

    /// A step up: the last packets are all later than the memory predicts, by more than jitter.
    fn note_step(&mut self, now: ServerTime) -> bool {
        let Some(settled_us) = self.settled_us else {
            return false;
        };
        if self.intervals.len() <= STEP_PACKETS {
            return false;
        }
        let recent = self
            .intervals
            .range(self.intervals.len() - STEP_PACKETS + 1..);
        // The required delay is smallest just after an arrival.
        let least = recent.map(|i| i.from_us).min().unwrap_or(0);
        if least <= settled_us + STEP_US {
            return false;
        }
        let before_us = self.rise.map_or(settled_us, |r| r.before_us);
        let began = self.rise.map_or(now, |r| r.began);
        let first = self.intervals.len() - STEP_PACKETS;
        self.intervals.drain(..first);
        let peak_us = self.intervals.iter().map(|i| i.to_us).max().unwrap_or(0);
        // The interval that ended with the step is longer than any after it.
        self.intervals.pop_front();
        self.rise = Some(Rise {
            began,
            before_us,
            peak_us,
        });
        true
    }

    /// A rise that ends soon was a burst; a lasting one is the new state of the path.
    fn note_burst(&mut self, now: ServerTime) {
        let Some(mut rise) = self.rise else { return };
        let Some(last) = self.intervals.back() else {
            return;
        };
        if last.from_us <= rise.before_us {
            self.bursts = Some(Bursts::note(self.bursts, rise.peak_us, now));
            self.rise = None;
        } else if now - rise.began > BURST_MAX {
            self.rise = None;
        } else {
            rise.peak_us = rise.peak_us.max(last.to_us);
            self.rise = Some(rise);
        }
    }

    /// The required delay from the memories, before the bridge is subtracted.
    fn settle(&mut self, now: ServerTime) -> i64 {
        if let Some(bursts) = &mut self.bursts {
            bursts.forget(now);
        }
        let long = self.quantile(now, LONG, SHARE);
        let short = self.quantile(now, SHORT, SHARE);
        let spread = long - self.quantile(now, LONG, 0.5);
        let settled_us = long.min(short);
        self.bridge_us = bridge(settled_us, spread);
        settled_us
    }

    /// The quantile of the required delay over time within a memory.
    fn quantile(&self, now: ServerTime, memory: Span, share: f64) -> i64 {
        // Within an interval the required delay rises linearly: its time above a level x is to - x.
        let mut ends: Vec<(i64, i64)> = Vec::with_capacity(2 * self.intervals.len());
        let mut total = 0;
        for i in self.intervals.iter().rev() {
            if now - i.until > memory {
                break;
            }
            let to_us = i.to_us.max(i.from_us + INTERVAL_MIN_US);
            total += to_us - i.from_us;
            ends.push((to_us, 1));
            ends.push((i.from_us, -1));
        }
        ends.sort_unstable_by(|a, b| b.cmp(a));
        let allowed = ((1.0 - share) * total as f64) as i64;
        let (mut above, mut open, mut level) = (0, 0, ends.first().map_or(0, |e| e.0));
        for (at, opens) in ends {
            let gained = open * (level - at);
            if open > 0 && above + gained >= allowed {
                return level - (allowed - above) / open;
            }
            above += gained;
            level = at;
            open += opens;
        }
        level
    }

    /// D*, microseconds; `None` before two packets.
    pub(super) fn wanted_us(&self) -> Option<i64> {
        let settled = self.settled_us? - self.bridge_us;
        let burst = self.bursts.and_then(|b| b.required_us);
        let burst = burst.map_or(0, |us| us + BURST_MARGIN_US);
        Some(settled.max(burst).max(0))
    }
}
