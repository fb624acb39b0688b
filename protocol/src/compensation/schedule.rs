//! D over server time.

use std::collections::VecDeque;

use super::{SLEW_DOWN, SLEW_UP};
use crate::operation::CompensationSettings;
use crate::{ServerTime, Span};

/// D over server time, as a function of the operation log.
///
/// From `effective_at` on, D moves from its current value towards the new one, by at most [`SLEW_UP`]
/// and [`SLEW_DOWN`] per second. Give it every `Compensation` operation in the order of the log; query
/// any later time.
///
/// A late operation arrives after its change has taken effect. A site with a display passes it to
/// [`handle_late_change`](Self::handle_late_change): the displayed moment then converges to that of the
/// other sites, and neither jumps nor runs backwards.
#[derive(Debug, Clone)]
pub struct DelaySchedule {
    changes: VecDeque<Change>,
    late_change: Option<LateChange>,
}

/// The remaining difference between the local D and the log's D after a late change.
#[derive(Debug, Clone, Copy)]
struct LateChange {
    at: ServerTime,
    by_us: f64,
}

impl LateChange {
    fn at(&self, t: ServerTime) -> f64 {
        if t < self.at {
            return 0.0;
        }
        let corrected = CATCH_UP * (t - self.at).as_micros() as f64;
        (self.by_us.abs() - corrected).max(0.0).copysign(self.by_us)
    }
}

/// The rate at which a site corrects D after a late change, seconds per second, in addition to
/// [`SLEW_UP`]: displayed time still advances, at a quarter of its speed for some milliseconds.
pub const CATCH_UP: f64 = 0.5;

#[derive(Debug, Clone, Copy)]
struct Change {
    from: ServerTime,
    at_start_us: f64,
    target_us: f64,
}

impl Change {
    fn at(&self, t: ServerTime) -> f64 {
        let elapsed = (t - self.from).as_micros().max(0) as f64;
        let difference = self.target_us - self.at_start_us;
        self.at_start_us + difference.clamp(-SLEW_DOWN * elapsed, SLEW_UP * elapsed)
    }
}

/// Changes remembered, so that past moments can be queried. At the server's shortest period,
/// [`RAISE_PERIOD`](super::RAISE_PERIOD), this is 3.2 s; older moments get the delay of the oldest
/// remembered change.
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
            late_change: None,
        }
    }

    /// Takes a `Compensation` operation. One that would take effect before its predecessor takes effect
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

    /// Takes a `Compensation` operation that arrives at a site with a display at time `now`: D continues
    /// from its current value and converges to the log's D by [`CATCH_UP`].
    pub fn handle_late_change(&mut self, delay_us: u32, effective_at: ServerTime, now: ServerTime) {
        let before_us = self.delay_us(now);
        self.late_change = None;
        self.handle_change(delay_us, effective_at);
        let by_us = before_us - self.delay_us(now);
        self.late_change = (by_us != 0.0).then_some(LateChange { at: now, by_us });
    }

    /// D at a moment.
    pub fn delay_at(&self, t: ServerTime) -> Span {
        Span::from_micros(self.delay_us(t).round() as i64)
    }

    fn delay_us(&self, t: ServerTime) -> f64 {
        let change = self
            .changes
            .iter()
            .rev()
            .find(|c| c.from <= t)
            .or(self.changes.front());
        change.map_or(0.0, |c| c.at(t)) + self.late_change.map_or(0.0, |b| b.at(t))
    }

    /// The moment τ = t - D(t) that is shown at server time t. It never runs backwards, because D
    /// grows more slowly than time.
    pub fn shown_at(&self, t: ServerTime) -> ServerTime {
        t - self.delay_at(t)
    }
}
