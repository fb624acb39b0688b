//! One site's measurement of the age of received motion.

use std::collections::VecDeque;

use super::bridged::BridgedDelay;
use super::{ALPHA, PERCENTILE_WINDOW};
use crate::lateness::Lateness;
use crate::request::DelayReport;
use crate::{ServerTime, Span};

/// Ages outside this range, in microseconds, mean that a clock was set: they do not measure the network.
/// A path of ten seconds would end the session.
const AGES: std::ops::RangeInclusive<i64> = -500_000..=10_000_000;

/// The minimum age is remembered for this long, in two halves.
const LEAST_MEMORY: Span = Span::from_millis(4000);

/// For this long, arrivals that machines delayed do not start a measurement.
const BEGIN_WITHIN: Span = Span::from_millis(1000);

/// Motion that arrived, with the lateness that machines caused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MotionArrival {
    /// When the newest sample was taken.
    pub generated: ServerTime,
    /// When it was handled here.
    pub arrived: ServerTime,
    /// Lateness that its sender and the server reported.
    pub late: Lateness,
    /// How long it may have waited here for a stalled receiver.
    pub stall: Span,
}

impl MotionArrival {
    /// Motion that no machine delayed.
    pub fn on_time(generated: ServerTime, arrived: ServerTime) -> Self {
        Self {
            generated,
            arrived,
            late: Lateness::NONE,
            stall: Span::ZERO,
        }
    }

    /// Whether a machine delayed it.
    fn is_delayed(&self) -> bool {
        self.stall > Span::ZERO || self.late != Lateness::NONE
    }

    /// Its age less the lateness that is reported.
    pub(crate) fn age(&self) -> Span {
        self.arrived - self.generated - self.late.newest
    }
}

/// The minimum age over the last [`LEAST_MEMORY`].
#[derive(Debug, Clone, Copy, Default)]
struct LeastAge {
    since: Option<ServerTime>,
    halves_us: [Option<i64>; 2],
}

impl LeastAge {
    /// Notes a measured age and returns the minimum.
    fn note(&mut self, age_us: i64, now: ServerTime) -> i64 {
        let half = Span::from_micros(LEAST_MEMORY.as_micros() / 2);
        if self.since.is_none_or(|since| (now - since).abs() >= half) {
            self.since = Some(now);
            self.halves_us = [None, self.halves_us[0]];
        }
        let current = self.halves_us[0].map_or(age_us, |least| least.min(age_us));
        self.halves_us[0] = Some(current);
        self.halves_us[1].map_or(current, |before| before.min(current))
    }
}

/// Which rule gives D* from the measured ages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DelayRule {
    /// μ + 4ν + packet interval.
    MeanDeviation,
    /// The 98th percentile of the last [`PERCENTILE_WINDOW`] ages + packet interval.
    Percentile,
    /// The delay after which the timeline can bridge the rest ([`BRIDGE`](super::BRIDGE)): the default.
    /// The other two rules cover nearly every packet and cost a third more delay than extrapolation
    /// needs.
    #[default]
    Bridged,
}

/// One site's measurement of the age of received motion.
#[derive(Debug, Clone)]
pub struct DelayEstimator {
    rule: DelayRule,
    mean_us: f64,
    deviation_us: f64,
    interval_us: f64,
    first_arrival: Option<ServerTime>,
    last_arrival: Option<ServerTime>,
    least: LeastAge,
    spike_us: Option<f64>,
    ages_us: VecDeque<i64>,
    bridged: BridgedDelay,
    urgent: bool,
    measured: u64,
    ignored: u64,
}

impl DelayEstimator {
    /// An estimator without measurements.
    pub fn new(rule: DelayRule) -> Self {
        Self {
            rule,
            mean_us: 0.0,
            deviation_us: 0.0,
            interval_us: 4000.0,
            first_arrival: None,
            last_arrival: None,
            least: LeastAge::default(),
            spike_us: None,
            ages_us: VecDeque::with_capacity(PERCENTILE_WINDOW),
            bridged: BridgedDelay::default(),
            urgent: false,
            measured: 0,
            ignored: 0,
        }
    }

    /// Notes motion that arrived while the delay `in_force` held. The lateness that machines caused is
    /// subtracted from its age, down to the minimum age of the last seconds: an exaggerated lateness
    /// report can not make the network seem faster. Returns the remaining age.
    pub fn handle_arrival(&mut self, motion: MotionArrival, in_force: Span) -> Span {
        let measured = (motion.arrived - motion.generated).as_micros();
        if !AGES.contains(&measured) {
            self.ignored += 1;
            return motion.age();
        }
        let arrival = motion.arrived;
        let first = *self.first_arrival.get_or_insert(arrival);
        // There is no measurement yet to compare a delayed arrival with.
        if self.measured == 0 && motion.is_delayed() && (arrival - first).abs() < BEGIN_WITHIN {
            return (motion.age() - motion.stall).max(Span::ZERO);
        }
        let least = self.least.note(measured, arrival);
        let taken_off = motion.late.newest.as_micros().min(measured - least);
        let latest = measured - taken_off;
        let earliest = (latest - motion.stall.as_micros().max(0)).max(least);
        // Within the uncertainty of a stall, the usual age is assumed.
        let d = (self.mean_us as i64).clamp(earliest, latest);
        let d_us = d as f64;
        let age = Span::from_micros(d);
        self.urgent |= (self.bridged).handle_arrival(&motion, Span::from_micros(taken_off), age);
        if self.ages_us.len() == PERCENTILE_WINDOW {
            self.ages_us.pop_front();
        }
        self.ages_us.push_back(d);
        if let Some(last) = self.last_arrival {
            // Packets that arrive together and gaps of a silent tool do not measure the interval.
            let gap = (arrival - last).as_micros() as f64;
            self.interval_us += ALPHA * (gap.clamp(0.0, 50_000.0) - self.interval_us);
        }
        self.last_arrival = Some(arrival);
        if self.measured == 0 {
            self.mean_us = d_us;
        }
        self.measured += 1;
        let in_force_us = in_force.as_micros() as f64;
        if d_us > in_force_us + 8.0 * self.deviation_us {
            self.spike_us = Some(d_us);
        } else if d_us <= in_force_us {
            self.spike_us = None;
        }
        self.mean_us += ALPHA * (d_us - self.mean_us);
        self.deviation_us += ALPHA * ((d_us - self.mean_us).abs() - self.deviation_us);
        age
    }

    /// The delay D* that this site needs; `None` before the first measurement.
    pub fn wanted(&self) -> Option<Span> {
        if self.measured == 0 {
            return None;
        }
        let settled = match self.rule {
            DelayRule::MeanDeviation => self.mean_us + 4.0 * self.deviation_us,
            DelayRule::Percentile => self.percentile_us(0.98),
            DelayRule::Bridged => {
                // One arrival is not enough: after a demotion, late motion of that participant may still
                // arrive.
                return self.bridged.wanted_us().map(Span::from_micros);
            }
        } + self.interval_us;
        let wanted = self.spike_us.map_or(settled, |spike| settled.max(spike));
        Some(Span::from_micros(wanted.max(0.0).round() as i64))
    }

    fn percentile_us(&self, p: f64) -> f64 {
        let mut ages: Vec<i64> = self.ages_us.iter().copied().collect();
        let index = ((ages.len() - 1) as f64 * p).round() as usize;
        *ages.select_nth_unstable(index).1 as f64
    }

    /// The mean age μ.
    pub fn mean(&self) -> Span {
        Span::from_micros(self.mean_us.round() as i64)
    }

    /// The mean deviation ν.
    pub fn deviation(&self) -> Span {
        Span::from_micros(self.deviation_us.round() as i64)
    }

    /// Whether D* follows an age far beyond D.
    pub fn in_spike(&self) -> bool {
        self.spike_us.is_some()
    }

    /// Whether the path has become slower since the last call. Report it at once: until D has grown all
    /// sites extrapolate.
    pub fn take_urgent(&mut self) -> bool {
        std::mem::take(&mut self.urgent) && self.rule == DelayRule::Bridged
    }

    /// The number of arrivals with an age that no network gives: a clock was set.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }

    /// The report for the server; `None` before the first measurement.
    pub fn report(&self) -> Option<DelayReport> {
        let us = |s: Span| u32::try_from(s.as_micros().max(0)).unwrap_or(u32::MAX);
        self.wanted().map(|wanted| DelayReport {
            mean_us: us(self.mean()),
            deviation_us: us(self.deviation()),
            wanted_us: us(wanted),
        })
    }
}
