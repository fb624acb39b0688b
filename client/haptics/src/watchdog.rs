//! Fades the force when its source is lost: an old contact model, a tool outside the model's radius, a lost link.
//! Each is a gain that falls from 1 to 0 without a step.
//!
//! The times count from the loss of the source to zero force AT THE HAND. The slew limit behind these gains may lag
//! by the time it needs to empty the largest force (`flush`), so each gain reaches zero that much earlier.

use palpate_protocol::{ClientTime, Span};

/// Fade times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WatchdogConfig {
    /// Age of a contact model at which its force begins to fade. Models come every 4 to 10 ms, so several are
    /// missing by then; a solver on a busy machine recovers earlier.
    pub stale_from: Span,
    /// Age of a contact model at which the force is zero.
    pub stale_zero: Span,
    /// Time outside the radius of validity after which the gain is zero.
    pub left_zero: Span,
    /// Time in which a faded gain recovers once its source is back.
    pub recover: Span,
    /// Time after the loss of the link at which the force is zero.
    pub link_zero: Span,
}

impl Default for WatchdogConfig {
    fn default() -> Self {
        Self {
            stale_from: Span::from_millis(75),
            stale_zero: Span::from_millis(150),
            left_zero: Span::from_millis(50),
            recover: Span::from_millis(100),
            link_zero: Span::from_millis(100),
        }
    }
}

/// Maximum solve time ahead of now. A later model was stamped by another clock, and counts as stale.
const FUTURE_MAX: Span = Span::from_millis(10);

/// Fades the force of a contact model that is old or whose radius the tool has left.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Watchdog {
    config: WatchdogConfig,
    /// The age at which the gain is zero.
    gain_zero_at: Span,
    fresh: f64,
    inside: f64,
}

/// Result of the watchdog in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Watched {
    pub(crate) gain: f64,
    pub(crate) is_stale: bool,
    pub(crate) has_left: bool,
}

impl Watchdog {
    /// A watchdog in front of a slew limit that empties the largest force in `flush`.
    pub(crate) fn new(config: WatchdogConfig, flush: Span) -> Self {
        let gain_zero_at = (config.stale_zero - flush).max(config.stale_from);
        Self {
            config,
            gain_zero_at,
            fresh: 1.0,
            inside: 1.0,
        }
    }

    /// One tick: the model's `age`, whether the tool `is_outside` its radius, whether it is in contact, the time
    /// since the last tick, and the part of it that counts towards recovery.
    pub(crate) fn advance(
        &mut self,
        age: Span,
        is_outside: bool,
        in_contact: bool,
        dt: Span,
        dt_up: Span,
    ) -> Watched {
        let up = dt_up.as_secs_f64() / self.config.recover.as_secs_f64();
        let by_age = if in_contact {
            self.gain_of_age(age)
        } else {
            1.0
        };
        self.fresh = by_age.min(self.fresh + up);
        let has_left = in_contact && is_outside;
        self.inside = if has_left {
            (self.inside - dt.as_secs_f64() / self.config.left_zero.as_secs_f64()).max(0.0)
        } else {
            (self.inside + up).min(1.0)
        };
        Watched {
            gain: self.fresh * self.inside,
            is_stale: by_age < 1.0,
            has_left,
        }
    }

    /// Whether a model of this age gives no force.
    pub(crate) fn is_lost(&self, age: Span) -> bool {
        age >= self.config.stale_zero
    }

    fn gain_of_age(&self, age: Span) -> f64 {
        if age < -FUTURE_MAX {
            return 0.0;
        }
        let over = (age - self.config.stale_from).as_secs_f64();
        let fade = (self.gain_zero_at - self.config.stale_from).as_secs_f64();
        if over <= 0.0 {
            1.0
        } else {
            (1.0 - over / fade.max(1e-9)).max(0.0)
        }
    }
}

/// Fades all force while the link to the session is lost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LinkGuard {
    fade: Span,
    lost_at: Option<ClientTime>,
}

impl LinkGuard {
    /// A guard in front of a slew limit that empties the largest force in `flush`.
    pub(crate) fn new(config: &WatchdogConfig, flush: Span) -> Self {
        Self {
            fade: (config.link_zero - flush).max(Span::ZERO),
            lost_at: None,
        }
    }

    /// The link was lost at `now`; a second loss does not restart the fade.
    pub(crate) fn lose(&mut self, now: ClientTime) {
        self.lost_at.get_or_insert(now);
    }

    /// The link is back; returns the gain at `now`.
    pub(crate) fn restore(&mut self, now: ClientTime) -> f64 {
        let gain = self.gain(now);
        self.lost_at = None;
        gain
    }

    /// Whether the link is lost.
    pub(crate) fn is_lost(&self) -> bool {
        self.lost_at.is_some()
    }

    /// The gain at `now`.
    pub(crate) fn gain(&self, now: ClientTime) -> f64 {
        self.lost_at.map_or(1.0, |at| {
            let since = (now - at).as_secs_f64();
            (1.0 - since / self.fade.as_secs_f64().max(1e-9)).clamp(0.0, 1.0)
        })
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::{ClientTime, Span};

    use super::{LinkGuard, Watchdog, WatchdogConfig};

    const MS: Span = Span::from_millis(1);

    #[test]
    fn a_model_fades_with_age_and_recovers_gradually() {
        let mut w = Watchdog::new(WatchdogConfig::default(), Span::from_millis(20));
        let gain = |w: &mut Watchdog, age_ms| {
            w.advance(Span::from_millis(age_ms), false, true, MS, MS)
                .gain
        };
        assert_eq!(gain(&mut w, 75), 1.0);
        assert!(gain(&mut w, 100) < 0.6);
        assert_eq!(gain(&mut w, 130), 0.0);
        assert!(gain(&mut w, 4) <= 0.011, "one tick later it is not back");
        for _ in 0..100 {
            gain(&mut w, 4);
        }
        assert_eq!(gain(&mut w, 4), 1.0);
    }

    #[test]
    fn a_tool_outside_the_radius_loses_force_in_time() {
        let mut w = Watchdog::new(WatchdogConfig::default(), Span::ZERO);
        let mut gain = 1.0;
        for _ in 0..51 {
            let now = w.advance(MS, true, true, MS, MS);
            assert!(now.has_left && now.gain < gain + 1e-12);
            gain = now.gain;
        }
        assert_eq!(gain, 0.0);
    }

    #[test]
    fn a_model_from_the_future_is_stale() {
        let mut w = Watchdog::new(WatchdogConfig::default(), Span::ZERO);
        let seen = w.advance(Span::from_millis(-5000), false, true, MS, MS);
        assert!(seen.is_stale && seen.gain == 0.0);
    }

    #[test]
    fn a_lost_link_ramps_to_zero_in_time() {
        let mut g = LinkGuard::new(&WatchdogConfig::default(), Span::from_millis(20));
        let at = |ms: i64| ClientTime::from_micros(ms * 1000);
        assert_eq!(g.gain(at(0)), 1.0);
        g.lose(at(10));
        g.lose(at(50));
        assert!((g.gain(at(50)) - 0.5).abs() < 1e-9);
        assert_eq!(g.gain(at(90)), 0.0);
        assert_eq!((g.restore(at(50)), g.gain(at(60))), (0.5, 1.0));
    }
}
