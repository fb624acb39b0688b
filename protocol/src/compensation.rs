//! Artificial time compensation: every site shows an event stamped t at t + D.
//!
//! Each site measures the age of what it receives (Lin 2007, chapter 6; the rule is
//! reconstructed):
//!
//! ```text
//! d = t_arrival - t_generated;   μ += α (d - μ);   ν += α (|d - μ| - ν)          α = 0.02
//! D* = μ + 4ν + packet interval, or the 98th percentile of the last 200 d + interval
//! spike mode: while d > D + 8ν, D* follows d at once; it ends when d falls below D again
//! group: D = max over participants, slewed by dD/dt in [-0.02, +0.25], D <= cap
//! ```
//!
//! [`DelayEstimator`] is one site's measurement, [`GroupDelay`] the server's decision,
//! [`DelaySchedule`] what everybody makes of the decisions: the same D at the same server time on
//! every site, because it is a function of the operations log alone.

use std::collections::VecDeque;

use crate::operation::{CompensationMode, CompensationSettings};
use crate::request::DelayReport;
use crate::{ParticipantId, ServerTime, Span};

/// Weight of the newest measurement in μ and ν: a memory of 50 packets, 0.2 s at 250 Hz.
pub const ALPHA: f64 = 0.02;

/// How fast D may shrink, seconds per second: a tool shown seems at most 2 % faster than it was.
pub const SLEW_DOWN: f64 = 0.02;

/// How fast D may grow, seconds per second: what is shown slows down to three quarters.
pub const SLEW_UP: f64 = 0.25;

/// The largest D of the adaptive rule unless the host raises it: beyond it two people no longer
/// work on one moment.
pub const CAP_DEFAULT: Span = Span::from_millis(200);

/// How many ages the percentile looks at; older ones are forgotten.
pub const PERCENTILE_WINDOW: usize = 200;

/// Which rule gives D* from the measured ages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DelayRule {
    /// μ + 4ν + packet interval.
    #[default]
    MeanDeviation,
    /// The 98th percentile of the last [`PERCENTILE_WINDOW`] ages + packet interval.
    Percentile,
}

/// One site's measurement of the age of what it receives.
#[derive(Debug, Clone)]
pub struct DelayEstimator {
    rule: DelayRule,
    mean_us: f64,
    deviation_us: f64,
    interval_us: f64,
    last_arrival: Option<ServerTime>,
    spike_us: Option<f64>,
    ages_us: VecDeque<i64>,
    measured: u64,
}

impl DelayEstimator {
    /// Nothing measured yet.
    pub fn new(rule: DelayRule) -> Self {
        Self {
            rule,
            mean_us: 0.0,
            deviation_us: 0.0,
            interval_us: 4000.0,
            last_arrival: None,
            spike_us: None,
            ages_us: VecDeque::with_capacity(PERCENTILE_WINDOW),
            measured: 0,
        }
    }

    /// Notes that something generated at one moment arrived at another, while the delay `in_force`
    /// held.
    pub fn handle_arrival(&mut self, generated: ServerTime, arrival: ServerTime, in_force: Span) {
        let d = (arrival - generated).as_micros();
        let d_us = d as f64;
        if self.ages_us.len() == PERCENTILE_WINDOW {
            self.ages_us.pop_front();
        }
        self.ages_us.push_back(d);
        if let Some(last) = self.last_arrival {
            // Packets that arrive together say nothing about the interval; gaps of a silent tool
            // neither.
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
    }

    /// The delay D* that this site needs; `None` before the first arrival.
    pub fn wanted(&self) -> Option<Span> {
        if self.measured == 0 {
            return None;
        }
        let settled = match self.rule {
            DelayRule::MeanDeviation => self.mean_us + 4.0 * self.deviation_us,
            DelayRule::Percentile => self.percentile_us(0.98),
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

    /// Whether an age far beyond D is being followed.
    pub fn in_spike(&self) -> bool {
        self.spike_us.is_some()
    }

    /// For the server; `None` before the first arrival.
    pub fn report(&self) -> Option<DelayReport> {
        let us = |s: Span| u32::try_from(s.as_micros().max(0)).unwrap_or(u32::MAX);
        self.wanted().map(|wanted| DelayReport {
            mean_us: us(self.mean()),
            deviation_us: us(self.deviation()),
            wanted_us: us(wanted),
        })
    }
}

/// D over server time, as the operations log says it.
///
/// From `effective_at` on, D moves from where it then is towards the new value, by at most
/// [`SLEW_UP`] and [`SLEW_DOWN`] per second. Give it every `Compensation` operation in the order of
/// the log; ask it for any time from then on.
#[derive(Debug, Clone)]
pub struct DelaySchedule {
    changes: VecDeque<Change>,
}

#[derive(Debug, Clone, Copy)]
struct Change {
    from: ServerTime,
    at_start_us: f64,
    target_us: f64,
}

impl Change {
    fn at(&self, t: ServerTime) -> f64 {
        let elapsed = (t - self.from).as_micros().max(0) as f64;
        let way = self.target_us - self.at_start_us;
        self.at_start_us + way.clamp(-SLEW_DOWN * elapsed, SLEW_UP * elapsed)
    }
}

/// Changes remembered, so that past moments can still be asked for. At the server's shortest
/// period of 250 ms this is 16 s; older moments get the delay of the oldest remembered change.
const CHANGES_MAX: usize = 64;

impl DelaySchedule {
    /// The schedule at the beginning of a session.
    pub fn new(settings: &CompensationSettings) -> Self {
        let initial_us = f64::from(settings.initial_delay_us);
        let first = Change {
            from: ServerTime::ZERO,
            at_start_us: initial_us,
            target_us: initial_us,
        };
        Self {
            changes: VecDeque::from([first]),
        }
    }

    /// A `Compensation` operation. One that would take effect before its predecessor takes effect
    /// with it.
    pub fn handle_change(&mut self, delay_us: u32, effective_at: ServerTime) {
        let last = self.changes.back().copied();
        let from = last.map_or(effective_at, |l| effective_at.max(l.from));
        let target_us = f64::from(delay_us);
        let at_start_us = last.map_or(target_us, |l| l.at(from));
        if self.changes.len() == CHANGES_MAX {
            self.changes.pop_front();
        }
        self.changes.push_back(Change {
            from,
            at_start_us,
            target_us,
        });
    }

    /// D at a moment.
    pub fn delay_at(&self, t: ServerTime) -> Span {
        let change = self
            .changes
            .iter()
            .rev()
            .find(|c| c.from <= t)
            .or(self.changes.front());
        Span::from_micros(change.map_or(0.0, |c| c.at(t)).round() as i64)
    }

    /// The moment τ = t - D(t) that is shown at server time t. It never runs backwards, because D
    /// grows more slowly than time.
    pub fn shown_at(&self, t: ServerTime) -> ServerTime {
        t - self.delay_at(t)
    }
}

/// The server's choice of D for the whole group.
///
/// Calling order: [`handle_report`](Self::handle_report) and [`remove`](Self::remove) as they
/// come, [`poll_change`](Self::poll_change) at least every 100 ms; what it gives becomes an
/// operation in the log, and is also given to the server's own [`DelaySchedule`].
#[derive(Debug, Clone)]
pub struct GroupDelay {
    mode: CompensationMode,
    target_us: u32,
    last_change: Option<ServerTime>,
    wanted: Vec<(ParticipantId, u32)>,
}

/// A decision of the server, to be written into the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DelayChange {
    /// The delay to reach, microseconds.
    pub delay_us: u32,
    /// From when on.
    pub effective_at: ServerTime,
}

/// Not more often than this is D changed, so that the log stays short.
pub const CHANGE_PERIOD: Span = Span::from_millis(250);

/// A smaller change than this is not worth an operation when growing; when shrinking it must be
/// four times as much.
pub const CHANGE_MIN: Span = Span::from_millis(2);

impl GroupDelay {
    /// The group at the beginning of a session.
    pub fn new(settings: &CompensationSettings) -> Self {
        Self {
            mode: settings.mode,
            target_us: settings.initial_delay_us,
            last_change: None,
            wanted: Vec::new(),
        }
    }

    /// What a site needs: a participant's report, or the server's own measurement of what it
    /// receives, under [`ParticipantId::SERVER`].
    pub fn handle_report(&mut self, who: ParticipantId, report: DelayReport) {
        match self.wanted.iter_mut().find(|(p, _)| *p == who) {
            Some((_, wanted)) => *wanted = report.wanted_us,
            None => self.wanted.push((who, report.wanted_us)),
        }
    }

    /// A participant went.
    pub fn remove(&mut self, who: ParticipantId) {
        self.wanted.retain(|(p, _)| *p != who);
    }

    /// Whether somebody needs more than the cap: what they are shown is extrapolated or held where
    /// it comes too late, and what they do is shown to others late.
    pub fn beyond_cap(&self) -> impl Iterator<Item = ParticipantId> + '_ {
        let cap = match self.mode {
            CompensationMode::Adaptive { cap_us } => cap_us,
            CompensationMode::None | CompensationMode::Fixed => u32::MAX,
        };
        self.wanted
            .iter()
            .filter(move |(_, w)| *w > cap)
            .map(|(p, _)| *p)
    }

    /// A new decision, if one is due. It takes effect `lead` from now: choose the time that an
    /// operation needs to reach everybody, so that all change together.
    pub fn poll_change(&mut self, now: ServerTime, lead: Span) -> Option<DelayChange> {
        let CompensationMode::Adaptive { cap_us } = self.mode else {
            return None;
        };
        if self
            .last_change
            .is_some_and(|last| now - last < CHANGE_PERIOD)
        {
            return None;
        }
        let wanted = self.wanted.iter().map(|(_, w)| *w).max()?.min(cap_us);
        let change = i64::from(wanted) - i64::from(self.target_us);
        let min = CHANGE_MIN.as_micros();
        if !(change >= min || change <= -4 * min) {
            return None;
        }
        self.target_us = wanted;
        self.last_change = Some(now);
        Some(DelayChange {
            delay_us: wanted,
            effective_at: now + lead,
        })
    }

    /// The delay last decided.
    pub fn target(&self) -> Span {
        Span::from_micros(i64::from(self.target_us))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    fn at(us: i64) -> ServerTime {
        ServerTime::from_micros(us)
    }

    fn adaptive(initial_us: u32, cap_us: u32) -> CompensationSettings {
        CompensationSettings {
            mode: CompensationMode::Adaptive { cap_us },
            initial_delay_us: initial_us,
        }
    }

    #[test]
    fn what_a_site_wants_covers_nearly_all_that_arrives() {
        for rule in [DelayRule::MeanDeviation, DelayRule::Percentile] {
            let mut rng = Pcg64::seed_from_u64(3);
            let mut estimator = DelayEstimator::new(rule);
            let (mut late, mut count) = (0, 0);
            for i in 0..5000_i64 {
                let d = 60_000 + rng.random_range(-10_000..10_000);
                if i > 1000 {
                    let wanted = estimator.wanted().unwrap().as_micros();
                    assert!((68_000..90_000).contains(&wanted), "{rule:?}: {wanted} µs");
                    count += 1;
                    late += i32::from(d > wanted);
                }
                let wanted = estimator.wanted().unwrap_or(Span::from_millis(80));
                estimator.handle_arrival(at(i * 4000), at(i * 4000 + d), wanted);
            }
            assert!(
                late * 50 < count,
                "{rule:?}: {late} of {count} came too late"
            );
        }
    }

    #[test]
    fn a_spike_is_followed_at_once_and_forgotten_when_it_is_over() {
        let mut estimator = DelayEstimator::new(DelayRule::MeanDeviation);
        let in_force = Span::from_millis(70);
        let mut t = 0;
        let mut feed = |estimator: &mut DelayEstimator, d: i64| {
            t += 4000;
            estimator.handle_arrival(at(t), at(t + d), in_force);
        };
        for i in 0..500 {
            feed(&mut estimator, 60_000 + i % 3 * 1000);
        }
        assert!(!estimator.in_spike());
        feed(&mut estimator, 180_000);
        assert!(estimator.in_spike());
        assert!(estimator.wanted() >= Some(Span::from_millis(180)));
        feed(&mut estimator, 60_000);
        assert!(!estimator.in_spike());
        assert!(estimator.wanted() < Some(Span::from_millis(100)));
    }

    #[test]
    fn the_schedule_is_one_function_of_the_log_and_never_runs_backwards() {
        let mut schedule = DelaySchedule::new(&adaptive(50_000, 200_000));
        schedule.handle_change(150_000, at(1_000_000));
        schedule.handle_change(60_000, at(2_000_000));
        assert_eq!(schedule.delay_at(at(900_000)), Span::from_millis(50));
        assert_eq!(schedule.delay_at(at(1_200_000)), Span::from_millis(100));
        assert_eq!(schedule.delay_at(at(2_000_000)), Span::from_millis(150));
        assert_eq!(schedule.delay_at(at(3_000_000)), Span::from_millis(130));
        assert_eq!(schedule.delay_at(at(9_000_000)), Span::from_millis(60));
        let mut last = schedule.shown_at(at(0));
        for ms in 1..10_000 {
            let shown = schedule.shown_at(at(ms * 1000));
            let rate = (shown - last).as_micros() as f64 / 1000.0;
            assert!(
                (1.0 - SLEW_UP - 0.002..=1.0 + SLEW_DOWN + 0.002).contains(&rate),
                "{rate}"
            );
            last = shown;
        }
    }

    #[test]
    fn the_group_follows_its_slowest_up_to_the_cap_and_names_who_is_beyond() {
        let mut group = GroupDelay::new(&adaptive(50_000, 200_000));
        let report = |wanted_us| DelayReport {
            wanted_us,
            ..DelayReport::default()
        };
        let (near, far) = (ParticipantId(1), ParticipantId(2));
        let lead = Span::from_millis(100);
        group.handle_report(near, report(70_000));
        group.handle_report(far, report(320_000));
        let change = group.poll_change(at(0), lead).unwrap();
        assert_eq!(
            (change.delay_us, change.effective_at),
            (200_000, at(100_000))
        );
        assert_eq!(group.beyond_cap().collect::<Vec<_>>(), [far]);
        assert_eq!(
            group.poll_change(at(100_000), lead),
            None,
            "not twice within the period"
        );
        group.remove(far);
        assert_eq!(
            group.poll_change(at(300_000), lead).unwrap().delay_us,
            70_000
        );
        assert_eq!(
            group.poll_change(at(900_000), lead),
            None,
            "nothing changed"
        );

        let mut raised = GroupDelay::new(&adaptive(50_000, 600_000));
        raised.handle_report(far, report(320_000));
        assert_eq!(raised.poll_change(at(0), lead).unwrap().delay_us, 320_000);
        assert_eq!(raised.beyond_cap().count(), 0);
    }

    #[test]
    fn a_fixed_delay_stays() {
        let settings = CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: 80_000,
        };
        let mut group = GroupDelay::new(&settings);
        group.handle_report(
            ParticipantId(1),
            DelayReport {
                wanted_us: 150_000,
                ..DelayReport::default()
            },
        );
        assert_eq!(group.poll_change(at(0), Span::ZERO), None);
        assert_eq!(
            DelaySchedule::new(&settings).delay_at(at(77)),
            Span::from_millis(80)
        );
    }
}
