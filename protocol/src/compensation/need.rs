//! What a delay must cover: how far the moment shown is from the newest sample, over time.
//!
//! A packet's age says how old a sample is when it comes. What a site shows in between rests on a
//! sample that grows older until the next one comes, so that the site needs, at every moment t,
//!
//! ```text
//! n(t) = t - (moment of the newest sample here)
//! ```
//!
//! With D >= n nothing is made up; with D < n the timeline goes n - D beyond its newest sample.
//! That is nearly free for a few milliseconds (`verlet`: 0.02 mm rms at 10 ms), so that D need not
//! cover everything: it is aimed [`BRIDGE`] or less below the [`SHARE`] of n.
//!
//! ```text
//! D* = max( q(n over LONG or SHORT + MARGIN, the lesser) - BRIDGE,  what a burst needed )
//! ```
//!
//! Three memories, because paths change in three ways (the rule is of our own making):
//! - a **step up** shows in a few packets, that all are beyond what D can bridge: what was before
//!   them says nothing any more and is forgotten;
//! - a **step down** shows when the short memory lies below the long one;
//! - a **burst** is a step up that is taken back within [`BURST_MAX`]. Where one was, another comes:
//!   its need is kept for [`BURST_MEMORY`], without counting on the bridge, because within a burst
//!   packets are missing too.
//!
//! A step that lasted is remembered for [`STEP_MEMORY`]: until then nothing is bridged, because what is
//! bridged already leaves less for the next one.

use std::collections::VecDeque;

use crate::{ServerTime, Span};

/// The farthest beyond the newest sample that the rule lets the timeline go at the edge of its
/// `SHARE`.
pub const BRIDGE: Span = Span::from_millis(12);

/// The least bridge: all of what a packet's interval needs, and nothing to be seen.
const BRIDGE_LEAST: Span = Span::from_millis(8);

/// The least bridge of a short path: there it is most of the delay, and what such a path gains at once is short too.
const BRIDGE_SHORT: Span = Span::from_micros(11_300);

/// A path counts as short up to the first need, and not at all from the second on; in between by parts.
const SHORT_PATH: [Span; 2] = [Span::from_millis(15), Span::from_millis(30)];

/// The bridge in spreads (from the median to the [`SHARE`]) of the need. A wide need is bridged now
/// and then, a narrow one would be all the time, and would leave nothing for when the path changes.
const BRIDGE_SPREADS: i64 = 2;

/// The share of the time in which D and the bridge together are to be enough.
const SHARE: f64 = 0.96;

/// The long memory: as many packets as give a steady quantile of jitter.
const LONG: Span = Span::from_millis(4000);

/// The short memory: what it lies below the long one is a step down.
const SHORT: Span = Span::from_millis(700);

/// The short memory's quantile is less steady: so much is added before it is believed.
const MARGIN_US: i64 = 5000;

/// Packets in a row, all later than anything bridged, that make a step up.
const STEP_PACKETS: usize = 3;

/// A step up is one when all of [`STEP_PACKETS`] are so much above the long memory's quantile.
const STEP_US: i64 = 6000;

/// A rise that lasts longer is no burst but how the path now is.
const BURST_MAX: Span = Span::from_millis(1200);

/// How long a burst's need is remembered: radio links have one every few seconds, and one on both
/// ways at once every few of those.
const BURST_MEMORY: Span = Span::from_millis(30_000);

/// A burst's need and so much more: the next one is a little worse as often as not.
const BURST_MARGIN_US: i64 = 5000;

/// How long it is remembered that the path had a step up: routes that change do so again within
/// minutes, and a path that changes has no use for a delay that is just enough.
const STEP_MEMORY: Span = Span::from_millis(30_000);

/// While that is remembered nothing is bridged and so much is added: what is left of the next step
/// is what has to be made up until D has grown.
const STEP_MARGIN_US: i64 = 2000;

/// Intervals remembered; at 250 Hz the long memory needs 1000, and a stream that is faster is
/// remembered for a shorter time.
const INTERVALS_MAX: usize = 2048;

/// The least time that an interval counts for: packets that come together show nothing in between.
const INTERVAL_MIN_US: i64 = 1;

/// The least bridge of a path with this need, microseconds.
fn bridge_least(need_us: i64) -> i64 {
    let [short, long] = SHORT_PATH.map(Span::as_micros);
    let extra = (BRIDGE_SHORT - BRIDGE_LEAST).as_micros();
    BRIDGE_LEAST.as_micros() + extra * (long - need_us).clamp(0, long - short) / (long - short)
}

/// What was needed from one packet to the next: from the age of the first on its arrival up to
/// that age and the time between them.
#[derive(Debug, Clone, Copy)]
struct Interval {
    until: ServerTime,
    from_us: i64,
    to_us: i64,
}

/// A rise of the need that may be a burst.
#[derive(Debug, Clone, Copy)]
struct Rise {
    began: ServerTime,
    before_us: i64,
    peak_us: i64,
}

/// What a site needs of D so that the timeline can bridge the rest.
#[derive(Debug, Clone, Default)]
pub(super) struct Need {
    newest: Option<ServerTime>,
    last_arrival: ServerTime,
    intervals: VecDeque<Interval>,
    settled_us: Option<i64>,
    bridge_us: i64,
    rise: Option<Rise>,
    burst: Option<(ServerTime, i64)>,
    stepped: Option<ServerTime>,
    since_sorted: u32,
}

impl Need {
    /// Notes a packet whose newest sample is of the moment `generated`. `true` when the path has
    /// just become slower: worth a report at once.
    pub(super) fn handle_arrival(&mut self, generated: ServerTime, arrival: ServerTime) -> bool {
        let Some(newest) = self.newest else {
            self.newest = Some(generated);
            self.last_arrival = arrival;
            return false;
        };
        if generated <= newest {
            return false;
        }
        let interval = Interval {
            until: arrival,
            from_us: (self.last_arrival - newest).as_micros(),
            to_us: (arrival - newest).as_micros(),
        };
        // A tool that was silent needed nothing.
        let silent = arrival - self.last_arrival > LONG || generated - newest > LONG;
        self.newest = Some(generated);
        self.last_arrival = self.last_arrival.max(arrival);
        if silent {
            return false;
        }
        self.remember(interval);
        let stepped = self.note_step(arrival);
        self.note_burst(arrival);
        // Quantiles of a thousand intervals for every packet would be spent for nothing.
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

    /// A step up: the last packets are all later than the memory says, by more than jitter.
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
        // Just after an arrival the need is at its least.
        let least = recent.map(|i| i.from_us).min().unwrap_or(0);
        if least <= settled_us + STEP_US {
            return false;
        }
        let before_us = self.rise.map_or(settled_us, |r| r.before_us);
        let began = self.rise.map_or(now, |r| r.began);
        let first = self.intervals.len() - STEP_PACKETS;
        self.intervals.drain(..first);
        let peak_us = self.intervals.iter().map(|i| i.to_us).max().unwrap_or(0);
        // The interval that waited for the step is longer than any after it.
        self.intervals.pop_front();
        self.rise = Some(Rise {
            began,
            before_us,
            peak_us,
        });
        true
    }

    /// A rise that ends soon was a burst; one that stays is how the path now is.
    fn note_burst(&mut self, now: ServerTime) {
        let Some(mut rise) = self.rise else { return };
        let Some(last) = self.intervals.back() else {
            return;
        };
        if last.from_us <= rise.before_us {
            let known_us = self.burst.map_or(0, |(_, us)| us);
            self.burst = Some((now, known_us.max(rise.peak_us)));
            self.rise = None;
        } else if now - rise.began > BURST_MAX {
            self.stepped = Some(now);
            self.rise = None;
        } else {
            rise.peak_us = rise.peak_us.max(last.to_us);
            self.rise = Some(rise);
        }
    }

    /// What the memories say, the bridge not yet taken off.
    fn settle(&mut self, now: ServerTime) -> i64 {
        if self.burst.is_some_and(|(at, _)| now - at > BURST_MEMORY) {
            self.burst = None;
        }
        let long = self.quantile(now, LONG, SHARE);
        let short = self.quantile(now, SHORT, SHARE);
        let spread = long - self.quantile(now, LONG, 0.5);
        if self.stepped.is_some_and(|at| now - at > STEP_MEMORY) {
            self.stepped = None;
        }
        let settled_us = long.min(short.saturating_add(MARGIN_US));
        self.bridge_us = match self.stepped {
            Some(_) => -STEP_MARGIN_US,
            None => (BRIDGE_SPREADS * spread).clamp(bridge_least(settled_us), BRIDGE.as_micros()),
        };
        settled_us
    }

    /// The need that is not exceeded for a share of the time within a memory.
    fn quantile(&self, now: ServerTime, memory: Span, share: f64) -> i64 {
        // Within an interval the need rises evenly: its time above a level x is to - x.
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
        let burst = self.burst.map_or(0, |(_, us)| us + BURST_MARGIN_US);
        Some(settled.max(burst).max(0))
    }
}
