//! The server's choice of the playout delay D.

use crate::operation::{CompensationMode, CompensationSettings};
use crate::request::DelayReport;
use crate::{ParticipantId, ServerTime, Span};

/// The server's choice of the playout delay D for the whole group.
///
/// Calling order: [`handle_report`](Self::handle_report) and [`remove`](Self::remove) as events occur,
/// [`poll_change`](Self::poll_change) at least every 100 ms. Its result becomes an operation in the log
/// and also goes to the server's own [`DelaySchedule`](super::DelaySchedule).
#[derive(Debug, Clone)]
pub struct GroupDelay {
    mode: CompensationMode,
    target_us: u32,
    last_change: Option<ServerTime>,
    wanted: Vec<(ParticipantId, u32)>,
    floor: Floor,
    /// See [`bound_predictions`](Self::bound_predictions).
    prediction_max_us: u32,
}

/// Minima of the server's own delay estimate and of the participants' worst report, over the current
/// half of [`PREDICTION_WINDOW`] and the one before.
///
/// When an uplink becomes slower, the server measures it first: the slow samples must still travel the
/// downlink, and the reports the uplink. Every participant's estimate will grow as much as the server's
/// has.
#[derive(Debug, Clone, Copy, Default)]
struct Floor {
    since: Option<ServerTime>,
    halves: [Option<Estimates>; 2],
}

#[derive(Debug, Clone, Copy)]
struct Estimates {
    server_us: u32,
    participants_us: u32,
}

impl Estimates {
    fn least(self, other: Self) -> Self {
        Self {
            server_us: self.server_us.min(other.server_us),
            participants_us: self.participants_us.min(other.participants_us),
        }
    }
}

impl Floor {
    /// The predicted delay estimate of all participants, microseconds: at least the reported one.
    fn predict(&mut self, estimates: Estimates, now: ServerTime) -> u32 {
        let half = Span::from_micros(PREDICTION_WINDOW.as_micros() / 2);
        if self.since.is_none_or(|since| now - since >= half) {
            self.since = Some(now);
            self.halves = [None, self.halves[0]];
        }
        self.halves[0] = Some(self.halves[0].map_or(estimates, |n| n.least(estimates)));
        let least = self
            .halves
            .into_iter()
            .flatten()
            .fold(estimates, Estimates::least);
        let rise_us = estimates.server_us - least.server_us;
        estimates
            .participants_us
            .max(least.participants_us.saturating_add(rise_us))
    }
}

/// A decision of the server, to be appended to the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DelayChange {
    /// The delay to reach, microseconds.
    pub delay_us: u32,
    /// When it takes effect.
    pub effective_at: ServerTime,
}

/// Minimum time between reductions of D, so that the log stays short.
pub const CHANGE_PERIOD: Span = Span::from_millis(250);

/// Minimum time between increases of D: shorter, because until then all sites extrapolate.
pub const RAISE_PERIOD: Span = Span::from_millis(50);

/// How long a rise of the server's own estimate is added to the earlier reports: by then the slow
/// samples have reached the participants, and their reports the server.
const PREDICTION_WINDOW: Span = Span::from_millis(600);

/// Time beyond the one-way delay that allows one retransmission of an operation on a short path.
const LEAD_MARGIN: Span = Span::from_millis(20);

/// A smaller change is not worth an operation. Where D is short, D / [`CHANGE_PART`] is the threshold.
pub const CHANGE_MIN: Span = Span::from_millis(2);

/// Divisor of D for the threshold where D is short: 2 ms of 5 ms matter.
pub const CHANGE_PART: i64 = 16;

/// Changes below this are measurement noise, however short D is.
const CHANGE_LEAST: Span = Span::from_micros(500);

impl GroupDelay {
    /// The group at the beginning of a session.
    pub fn new(settings: &CompensationSettings) -> Self {
        Self {
            mode: settings.mode,
            target_us: settings.initial_delay_us,
            last_change: None,
            wanted: Vec::new(),
            floor: Floor::default(),
            prediction_max_us: u32::MAX,
        }
    }

    /// Changes the rule. Without artificial delay D goes to zero; a fixed D stays as it is.
    pub fn set_mode(&mut self, mode: CompensationMode) {
        self.mode = mode;
    }

    /// Takes a site's delay estimate: a participant's report, or the server's own measurement of
    /// received motion, under [`ParticipantId::SERVER`]. One beyond the cap cannot be bridged and changes nothing.
    pub fn handle_report(&mut self, who: ParticipantId, report: DelayReport) {
        if !self.can_bridge(&report) {
            return;
        }
        match self.wanted.iter_mut().find(|(p, _)| *p == who) {
            Some((_, wanted)) => *wanted = report.wanted_us,
            None => self.wanted.push((who, report.wanted_us)),
        }
    }

    /// Bounds predictions by the longest path that measurements explain, µs: a prediction adds a rise of the server's
    /// estimate to an earlier report, although both may be of one path.
    pub fn bound_predictions(&mut self, path_us: u32) {
        self.prediction_max_us = path_us;
    }

    /// Whether the cap allows the delay that a participant needs.
    pub fn can_bridge(&self, report: &DelayReport) -> bool {
        report.wanted_us <= self.cap_us()
    }

    fn cap_us(&self) -> u32 {
        u32::try_from(self.mode.cap().as_micros()).unwrap_or(u32::MAX)
    }

    /// Forgets a participant that left.
    pub fn remove(&mut self, who: ParticipantId) {
        self.wanted.retain(|(p, _)| *p != who);
    }

    /// Returns a new decision if one is due. It takes effect `lead` from now: choose a lead within which
    /// an operation reaches every site, so that all sites change together.
    pub fn poll_change(&mut self, now: ServerTime, lead: Span) -> Option<DelayChange> {
        match self.mode {
            CompensationMode::Adaptive { .. } => {}
            CompensationMode::None => return self.end_delay(now, lead),
            CompensationMode::Fixed => return None,
        }
        let (server, participants): (Vec<_>, Vec<_>) =
            (self.wanted.iter()).partition(|(p, _)| *p == ParticipantId::SERVER);
        let most =
            |estimates: Vec<&(ParticipantId, u32)>| estimates.into_iter().map(|(_, w)| *w).max();
        let wanted = match (most(server), most(participants)) {
            (Some(server_us), Some(participants_us)) => {
                let estimates = Estimates {
                    server_us,
                    participants_us,
                };
                let predicted = self.floor.predict(estimates, now);
                predicted.min(self.prediction_max_us).max(server_us)
            }
            (server, participants) => server.max(participants)?,
        }
        .min(self.cap_us());
        let change = i64::from(wanted) - i64::from(self.target_us);
        let part = i64::from(self.target_us) / CHANGE_PART;
        let min = part.clamp(CHANGE_LEAST.as_micros(), CHANGE_MIN.as_micros());
        if !(change >= min || change <= -min) {
            return None;
        }
        let period = if change > 0 {
            RAISE_PERIOD
        } else {
            CHANGE_PERIOD
        };
        if self.last_change.is_some_and(|last| now - last < period) {
            return None;
        }
        self.target_us = wanted;
        self.last_change = Some(now);
        Some(DelayChange {
            delay_us: wanted,
            effective_at: now + lead,
        })
    }

    /// The change to no delay, after a change of the rule.
    fn end_delay(&mut self, now: ServerTime, lead: Span) -> Option<DelayChange> {
        if self.target_us == 0 {
            return None;
        }
        self.target_us = 0;
        self.last_change = Some(now);
        Some(DelayChange {
            delay_us: 0,
            effective_at: now + lead,
        })
    }

    /// A lead for [`poll_change`](Self::poll_change) within which an operation reaches every site: the
    /// delay estimates cover uplink plus downlink, an operation takes only the downlink.
    pub fn lead(&self) -> Span {
        // No change takes effect before an earlier one, so that one report must not postpone all later
        // changes.
        let wanted = self.wanted.iter().map(|(_, w)| *w).max().unwrap_or(0);
        let longest = wanted.max(self.target_us);
        LEAD_MARGIN + Span::from_micros(i64::from(longest) / 2)
    }

    /// The delay last decided.
    pub fn target(&self) -> Span {
        Span::from_micros(i64::from(self.target_us))
    }
}
