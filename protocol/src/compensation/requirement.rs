//! The delay requirement of a site: how far behind the present it must display motion to have its samples.
//!
//! A packet's age is the age of a sample on arrival. Until the next one arrives the newest sample grows older:
//!
//! ```text
//! n(t)    t - (moment of the newest sample here)
//! level   n without its peaks: the morphological opening of n by LEVEL_WINDOW
//! q       the SHARE quantile over time of n - level, with the forgetting factor exp(-dt / MEMORY)
//! step    n was above level + q for all of STEP_WINDOW and STEP_PACKETS: its minimum there is the level, and q at most
//!         BRIDGE
//! stall   n exceeds the cap: it enters no quantile, and D* is held
//! D*      level + q, less what the timeline extrapolates well (`bridge`)
//! ```
//!
//! The level follows changes of the route, the quantile covers jitter, losses and recurring bursts. The level falls
//! with the first fast packet and rises with a step, so that D* returns after a single burst. A burst enters the
//! quantile once both its sides are known, [`LEVEL_WINDOW`] later. Bursts are covered if they take more than
//! 1 - [`SHARE`] of the time.

use std::collections::VecDeque;
use std::ops::Range;

use super::estimator::MotionArrival;
use crate::{ServerTime, Span};

/// The longest extrapolation beyond the newest sample that the rule plans for: up to 10 ms cost 0.02 mm rms (`verlet`).
pub const BRIDGE: Span = Span::from_millis(12);

/// The share of the time that D and the bridge together are to cover.
const SHARE: f64 = 0.96;

/// Time constant of the quantile: the peaks of half a minute.
const MEMORY: Span = Span::from_millis(30_000);

/// A longer rise is the new level of the path, not a burst.
const LEVEL_WINDOW: Span = Span::from_millis(1200);

/// A step is a rise of all packets within this time and of the one before it: at 250 Hz of five.
const STEP_WINDOW: Span = Span::from_millis(14);

/// Minimum number of packets in a step: after a pause of their sender the window holds a single arrival.
const STEP_PACKETS: usize = 4;

/// The quantile of a path without jitter is a packet interval; jitter is beyond it.
const PACKET: Span = Span::from_millis(4);

/// Shorter paths are bridged even without jitter, because the bridge is most of their delay.
const SHORT_PATH: Span = Span::from_micros(25_500);

/// A tool that was silent for longer needs no delay.
const SILENCE: Span = Span::from_millis(4000);

/// Packets from one quantile to the next.
const PACKETS_PER_QUANTILE: u32 = 8;

/// Intervals remembered. At 250 Hz two windows have 600; a faster stream is remembered for a shorter time.
const INTERVALS_MAX: usize = 2048;

/// A report is repeated at once when a step has grown by this much since.
const STEP_REPORTED: Span = Span::from_millis(4);

/// Width of a histogram class.
const CLASS_US: i64 = 500;

/// The extrapolation that replaces delay on a path with this level plus quantile, microseconds: the jitter, up to
/// [`BRIDGE`]. A path without jitter keeps the whole bridge for a change.
fn bridge_us(required_us: i64, quantile_us: i64) -> i64 {
    let jitter_us = quantile_us - PACKET.as_micros();
    let short_us = SHORT_PATH.as_micros() - required_us;
    jitter_us.max(short_us).clamp(0, BRIDGE.as_micros())
}

/// The requirement from one packet to the next: from the age of the first on its arrival up to that age plus the
/// time between them.
#[derive(Debug, Clone, Copy)]
struct Interval {
    until: ServerTime,
    from_us: i64,
    to_us: i64,
}

/// Time that the requirement spent in each class above its level, microseconds.
#[derive(Debug, Clone, Default)]
struct Histogram {
    classes: Vec<f64>,
}

impl Histogram {
    /// Adds a requirement that rose linearly between two heights above the level.
    fn add(&mut self, from_us: i64, to_us: i64) {
        let from_us = from_us.max(0);
        let to_us = to_us.max(from_us + 1);
        let last = ((to_us - 1) / CLASS_US) as usize;
        if self.classes.len() <= last {
            self.classes.resize(last + 1, 0.0);
        }
        for class in (from_us / CLASS_US) as usize..=last {
            let low_us = class as i64 * CLASS_US;
            let part_us = to_us.min(low_us + CLASS_US) - from_us.max(low_us);
            self.classes[class] += part_us as f64;
        }
    }

    fn forget(&mut self, elapsed: Span) {
        let factor = (-elapsed.as_secs_f64() / MEMORY.as_secs_f64()).exp();
        self.classes.iter_mut().for_each(|time| *time *= factor);
    }

    fn quantile_us(&self, share: f64) -> i64 {
        let mut above = (1.0 - share) * self.classes.iter().sum::<f64>();
        for (class, &time) in self.classes.iter().enumerate().rev() {
            if time > above {
                return ((class as f64 + 1.0 - above / time) * CLASS_US as f64) as i64;
            }
            above -= time;
        }
        0
    }
}

/// The estimate of D* from arrivals.
#[derive(Debug, Clone)]
pub(super) struct Requirement {
    cap_us: i64,
    /// The newest sample and its age on arrival.
    newest: Option<(ServerTime, Span)>,
    last_arrival: ServerTime,
    intervals: VecDeque<Interval>,
    /// Number of leading intervals that the histogram has.
    learnt: usize,
    learnt_until: Option<ServerTime>,
    peaks: Histogram,
    quantile_us: i64,
    since_quantile: u32,
    wanted_us: Option<i64>,
    /// D* as last reported during the present step.
    step_us: Option<i64>,
}

impl Requirement {
    pub(super) fn new(cap: Span) -> Self {
        Self {
            cap_us: cap.as_micros(),
            newest: None,
            last_arrival: ServerTime::ZERO,
            intervals: VecDeque::new(),
            learnt: 0,
            learnt_until: None,
            peaks: Histogram::default(),
            quantile_us: 0,
            since_quantile: 0,
            wanted_us: None,
            step_us: None,
        }
    }

    pub(super) fn cap(&self) -> Span {
        Span::from_micros(self.cap_us)
    }

    pub(super) fn set_cap(&mut self, cap: Span) {
        self.cap_us = cap.as_micros();
    }

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
        // The requirement just before its arrival, had its oldest news left in time.
        let oldest = generated - newest + taken_off - motion.late.oldest + age;
        let interval = Interval {
            until: arrival,
            from_us: age_before.as_micros(),
            to_us: oldest.max(age).max(age_before).as_micros(),
        };
        let silent = arrival - self.last_arrival > SILENCE || generated - newest > SILENCE;
        self.newest = Some((generated, age));
        self.last_arrival = self.last_arrival.max(arrival);
        if silent {
            return false;
        }
        if self.intervals.len() == INTERVALS_MAX {
            self.forget_intervals(1);
        }
        self.intervals.push_back(interval);
        // Quantiles for every packet would be wasted.
        self.since_quantile += 1;
        if self.since_quantile >= PACKETS_PER_QUANTILE || self.wanted_us.is_none() {
            self.since_quantile = 0;
            self.learn(arrival);
        }
        self.follow(arrival, age.as_micros())
    }

    fn forget_intervals(&mut self, count: usize) {
        self.intervals.drain(..count);
        self.learnt = self.learnt.saturating_sub(count);
    }

    /// The number of leading intervals that ended at least one window before `at`.
    fn before_window(&self, at: ServerTime) -> usize {
        let ended = |i: &Interval| at - i.until >= LEVEL_WINDOW;
        self.intervals.partition_point(ended)
    }

    /// The smallest requirement of some intervals.
    fn least_us(&self, range: Range<usize>) -> Option<i64> {
        self.intervals.range(range).map(|i| i.from_us).min()
    }

    /// Adds the intervals with a known future to the histogram, and renews the quantile.
    fn learn(&mut self, now: ServerTime) {
        let all = self.intervals.len();
        let known = self.before_window(now);
        if known > self.learnt {
            let at = self.intervals[known - 1].until;
            let past = self.before_window(at);
            let past_us = self.least_us(past..known);
            let level_us = past_us.max(self.least_us(known..all)).unwrap_or(0);
            let elapsed = self.learnt_until.map_or(Span::ZERO, |until| at - until);
            self.learnt_until = Some(at);
            self.peaks.forget(elapsed.max(Span::ZERO));
            let new = self.intervals.range(self.learnt..known);
            for i in new.filter(|i| i.to_us <= self.cap_us) {
                self.peaks.add(i.from_us - level_us, i.to_us - level_us);
            }
            self.learnt = known;
            self.forget_intervals(past);
        }
        self.quantile_us = if self.learnt_until.is_some() {
            self.peaks.quantile_us(SHARE)
        } else {
            let level_us = self.least_us(0..all).unwrap_or(0);
            let mut first = Histogram::default();
            for i in self.intervals.iter().filter(|i| i.to_us <= self.cap_us) {
                first.add(i.from_us - level_us, i.to_us - level_us);
            }
            first.quantile_us(SHARE)
        };
    }

    /// Renews D*; returns whether a step must be reported at once.
    fn follow(&mut self, now: ServerTime, age_us: i64) -> bool {
        // Each interval begins with the age of the packet before. The minimum counts in both windows, so that the level is
        // never above the step.
        let least_us = |window: Span| {
            let recent = self.intervals.iter().rev().zip(2..);
            let recent = recent.take_while(|(i, n)| *n <= STEP_PACKETS || now - i.until < window);
            recent.map(|(i, _)| i.from_us).fold(age_us, i64::min)
        };
        let (level_us, step_us) = (least_us(LEVEL_WINDOW), least_us(STEP_WINDOW));
        // Peaks beyond the cap are not bridged; a level beyond it is.
        let required_us = (level_us + self.quantile_us).min(self.cap_us.max(level_us));
        let wanted_us =
            |required_us| (required_us - bridge_us(required_us, self.quantile_us)).max(0);
        if step_us <= required_us {
            self.step_us = None;
            self.wanted_us = Some(wanted_us(required_us));
            return false;
        }
        let required_us = step_us + self.quantile_us.min(BRIDGE.as_micros());
        if required_us > self.cap_us {
            return false;
        }
        let wanted_us = wanted_us(required_us);
        self.wanted_us = Some(wanted_us);
        let known_us = self
            .step_us
            .map_or(i64::MIN, |us| us + STEP_REPORTED.as_micros());
        let is_urgent = wanted_us > known_us;
        if is_urgent {
            self.step_us = Some(wanted_us);
        }
        is_urgent
    }

    /// D*, microseconds; `None` before two packets.
    pub(super) fn wanted_us(&self) -> Option<i64> {
        self.wanted_us
    }
}
