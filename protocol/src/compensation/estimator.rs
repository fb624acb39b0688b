//! One site's measurement of the age of received motion.

use super::requirement::Requirement;
use super::{ALPHA, CAP_DEFAULT};
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

/// One site's measurement of the age of received motion.
#[derive(Debug, Clone)]
pub struct DelayEstimator {
    mean_us: f64,
    deviation_us: f64,
    first_arrival: Option<ServerTime>,
    least: LeastAge,
    requirement: Requirement,
    urgent: bool,
    measured: u64,
    ignored: u64,
}

impl Default for DelayEstimator {
    fn default() -> Self {
        Self::new(CAP_DEFAULT)
    }
}

impl DelayEstimator {
    /// A measurement of a session whose D is at most `cap`. Longer stalls are not measured.
    pub fn new(cap: Span) -> Self {
        Self {
            mean_us: 0.0,
            deviation_us: 0.0,
            first_arrival: None,
            least: LeastAge::default(),
            requirement: Requirement::new(cap),
            urgent: false,
            measured: 0,
            ignored: 0,
        }
    }

    /// Changes the largest D.
    pub fn set_cap(&mut self, cap: Span) {
        self.requirement.set_cap(cap);
    }

    /// Forgets the path, because another one begins.
    pub fn restart(&mut self) {
        *self = Self::new(self.requirement.cap());
    }

    /// Notes motion that arrived. The lateness that machines caused is subtracted from its age, down to
    /// the minimum age of the last seconds: an exaggerated lateness report can not make the network seem
    /// faster. Returns the remaining age.
    pub fn handle_arrival(&mut self, motion: MotionArrival) -> Span {
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
        self.urgent |=
            (self.requirement).handle_arrival(&motion, Span::from_micros(taken_off), age);
        if self.measured == 0 {
            self.mean_us = d_us;
        }
        self.measured += 1;
        self.mean_us += ALPHA * (d_us - self.mean_us);
        self.deviation_us += ALPHA * ((d_us - self.mean_us).abs() - self.deviation_us);
        age
    }

    /// The delay D* that this site needs; `None` before the second measurement: after a demotion, late
    /// motion of that participant may still arrive.
    pub fn wanted(&self) -> Option<Span> {
        self.requirement.wanted_us().map(Span::from_micros)
    }

    /// Whether the path has become slower since the last call. Report it at once: until D has grown all
    /// sites extrapolate.
    pub fn take_urgent(&mut self) -> bool {
        std::mem::take(&mut self.urgent)
    }

    /// The number of arrivals with an age that no network gives: a clock was set.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }

    /// The report for the server; `None` as long as nothing is [wanted](Self::wanted).
    pub fn report(&self) -> Option<DelayReport> {
        // The conversion saturates.
        let us = |x: f64| x.round() as u32;
        self.wanted().map(|wanted| DelayReport {
            mean_us: us(self.mean_us),
            deviation_us: us(self.deviation_us),
            wanted_us: us(wanted.as_micros() as f64),
        })
    }
}
