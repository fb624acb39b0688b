//! The server's clock as a client knows it.
//!
//! A probe leaves the client at t0 and reaches the server at t1; the answer leaves at t2 and is
//! back at t3 (t0, t3 on the client's clock, t1, t2 on the server's).
//!
//! ```text
//! r = (t3 - t0) - (t2 - t1)            time on the way, both ways
//! θ = ((t1 - t0) + (t2 - t3)) / 2      offset, wrong by at most r / 2
//! ```
//!
//! Queues only ever add, to either way. So the offset line θ(t) = a + ρ t lies below every
//! `t1 - t0` and above every `t2 - t3`, and the widest strip of one slope ρ that has all of the first
//! above it and all of the second below it touches the fastest packets of each way: its slope is the
//! drift, its middle the offset. Each way finds its own fastest packet, where the smallest round trip
//! needs both at once: with 5 ms of jitter the middle is five times nearer to the truth. Moon, Skelly and
//! Towsley (INFOCOM 1999) find the skew of one way by a linear programme: the line under all delays that is
//! nearest to them. That of both ways at once and the offset in its middle are our own. Slower packets do not
//! touch it, so that a path may become slower and faster again. Where jitter has no edge to be touched, the mean
//! of all answers is surer and counts instead (`line`). From the first lock on, the map never steps: what it
//! lacks is made up at a rate of at most [`SLEW_MAX`].
//!
//! A way that is always slower than the other can not be told from an offset: the bound says so. An
//! answer that no offset within the bounds explains means that one of the two clocks was set. After
//! [`STEP_REPLIES`] such answers the estimate begins anew, without a map until it is locked, and counts
//! it in [`ClockEstimate::steps`]: whoever is in contact must let go, because no rate leads there.

mod line;

use std::collections::VecDeque;

use crate::datagram::{Probe, Reply};
use crate::{ClientTime, ServerTime, Span};
use line::{Answers, Measurement};

/// An answer that took longer is none.
pub const WINDOW: Span = Span::from_millis(4000);

/// How far back the strip reaches: long, because a jitter of 1 ms over 4 s looks like 250 ppm.
pub const DRIFT_WINDOW: Span = Span::from_millis(40_000);

/// Steepest slope that is looked for: crystals are within 100 ppm, two of them within 200.
const DRIFT_MAX: f64 = 200e-6;

/// How wrong the drift may be once [`DRIFT_MIN`] is there; before it is [`DRIFT_MAX`].
const DRIFT_UNSURE: f64 = 30e-6;

/// Answers in a row that contradict the map before a clock counts as set: one may be damaged.
pub const STEP_REPLIES: usize = 3;

/// The least history that gives a drift; before, it counts as none.
const DRIFT_MIN: Span = Span::from_millis(5000);

/// The largest rate of the map against the client's clock. Crystals differ by 100 ppm at most, so
/// that it can follow any, and 500 ppm can be seen by nobody.
pub const SLEW_MAX: f64 = 500e-6;

/// What is lacking is made up within this time, if the slew allows.
const SETTLE_US: f64 = 2e6;

/// Answers before the first lock: at 20 ms between probes, 0.16 s and a round trip.
pub const LOCK_REPLIES: usize = 8;

/// Measurements kept; at 10 Hz [`DRIFT_WINDOW`] needs 400.
const KEPT_MAX: usize = 512;

/// From a client's own clock to the server's and back, valid until the next one replaces it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockMap {
    anchor: ClientTime,
    offset_us: f64,
    rate: f64,
    error_bound: Span,
}

impl ClockMap {
    /// A map that knows the truth: for a server that is its own client, and for tests.
    pub const fn exact(offset: Span) -> Self {
        Self {
            anchor: ClientTime::ZERO,
            offset_us: offset.as_micros() as f64,
            rate: 0.0,
            error_bound: Span::ZERO,
        }
    }

    fn offset_at(&self, t: ClientTime) -> f64 {
        self.offset_us + self.rate * (t - self.anchor).as_micros() as f64
    }

    /// The server's time at a moment of one's own.
    pub fn to_server(&self, t: ClientTime) -> ServerTime {
        ServerTime::from_micros(
            t.as_micros()
                .saturating_add(self.offset_at(t).round() as i64),
        )
    }

    /// One's own time at a moment of the server's.
    pub fn to_client(&self, t: ServerTime) -> ClientTime {
        let at_anchor = self.anchor.as_micros() as f64 + self.offset_us;
        let since = (t.as_micros() as f64 - at_anchor) / (1.0 + self.rate);
        ClientTime::from_micros(self.anchor.as_micros().saturating_add(since.round() as i64))
    }

    /// How far the map can be from the truth: half of the round trip that it rests on, and what is
    /// still to be made up. A path that is slower one way than the other can not be told from an
    /// offset.
    pub fn error_bound(&self) -> Span {
        self.error_bound
    }
}

/// The estimate of the server's clock. Calling order: [`probe`](Self::probe) makes a probe to
/// send; [`handle_reply`](Self::handle_reply) takes its answer and gives the new map.
#[derive(Debug, Clone, Default)]
pub struct ClockEstimate {
    last_probe: u32,
    recent: VecDeque<Measurement>,
    /// Answers in a row that contradict the map.
    contradicting: Vec<Measurement>,
    map: Option<ClockMap>,
    steps: u64,
}

impl ClockEstimate {
    /// Nothing known.
    pub fn new() -> Self {
        Self::default()
    }

    /// The next probe, to be sent now.
    pub fn probe(&mut self, now: ClientTime) -> Probe {
        self.last_probe = self.last_probe.wrapping_add(1);
        Probe {
            id: self.last_probe,
            client_sent: now,
        }
    }

    /// Takes an answer that arrived now. `None` until the clock is locked, and for what can not be
    /// an answer of ours.
    pub fn handle_reply(&mut self, reply: Reply, now: ClientTime) -> Option<ClockMap> {
        let up_and_down = (now - reply.client_sent).as_micros();
        let at_server = (reply.server_sent - reply.server_received).as_micros();
        let rtt_us = up_and_down.saturating_sub(at_server);
        let known = reply.id <= self.last_probe;
        if !known || at_server < 0 {
            return None;
        }
        if reply.client_sent > now || rtt_us < 0 || up_and_down > WINDOW.as_micros() {
            // Our own clock was set while the probe was on its way, or the answer is very late: it
            // measures nothing. The next ones tell.
            return None;
        }
        let measurement = Measurement {
            at: reply.client_sent + Span::from_micros(up_and_down / 2),
            rtt_us,
            above_us: (reply.server_received.as_micros())
                .saturating_sub(reply.client_sent.as_micros()),
            below_us: (reply.server_sent.as_micros()).saturating_sub(now.as_micros()),
        };
        if self.contradicts(&measurement) {
            self.contradicting.push(measurement);
            if self.contradicting.len() < STEP_REPLIES {
                return None;
            }
            self.recent = self.contradicting.drain(..).collect();
            self.map = None;
            self.steps += 1;
            return None;
        }
        self.contradicting.clear();
        self.remember(measurement, now);
        if self.map.is_none() && self.recent.len() < LOCK_REPLIES {
            return None;
        }
        self.update(now)
    }

    /// Whether no offset within the bounds explains a measurement.
    fn contradicts(&self, m: &Measurement) -> bool {
        let far = |offset_us: f64, bound_us: f64| {
            (m.offset_us() - offset_us).abs() > bound_us + (m.rtt_us / 2 + 1) as f64
        };
        match (&self.map, self.recent.back()) {
            (Some(map), Some(last)) => {
                let since_us = (m.at - last.at).as_micros().unsigned_abs() as f64;
                let bound_us = map.error_bound.as_micros() as f64 + DRIFT_MAX * since_us;
                far(map.offset_at(m.at), bound_us)
            }
            (None, Some(last)) => {
                let since_us = (m.at - last.at).as_micros().unsigned_abs() as f64;
                far(
                    last.offset_us(),
                    (last.rtt_us / 2) as f64 + DRIFT_MAX * since_us,
                )
            }
            _ => false,
        }
    }

    fn remember(&mut self, m: Measurement, now: ClientTime) {
        while self.recent.len() == KEPT_MAX
            || (self.recent.front()).is_some_and(|old| now - old.at > DRIFT_WINDOW)
        {
            self.recent.pop_front();
        }
        self.recent.push_back(m);
    }

    fn update(&mut self, now: ClientTime) -> Option<ClockMap> {
        let line = Answers {
            answers: &self.recent,
        }
        .line(now);
        let target_us = line.middle_us;
        let (offset_us, rate) = match &self.map {
            None => (target_us, line.slope),
            Some(map) => {
                let offset_us = map.offset_at(now);
                let lacking = (target_us - offset_us) / SETTLE_US;
                (offset_us, (line.slope + lacking).clamp(-SLEW_MAX, SLEW_MAX))
            }
        };
        self.map = Some(ClockMap {
            anchor: now,
            offset_us,
            rate,
            error_bound: self.bound(now, offset_us, line.slope),
        });
        self.map
    }

    /// How far the map can be from the truth now: every measurement bounds it, the newest by its
    /// round trip alone, older ones also by what the drift may have done since.
    fn bound(&self, now: ClientTime, offset_us: f64, slope: f64) -> Span {
        let history = self.recent.back().zip(self.recent.front());
        let is_long = history.is_some_and(|(last, first)| last.at - first.at >= DRIFT_MIN);
        let unsure = if is_long { DRIFT_UNSURE } else { DRIFT_MAX };
        let bounds = self.recent.iter().map(|m| {
            let age_us = (now - m.at).as_micros() as f64;
            let there = m.offset_us() + slope * age_us;
            0.5 * m.rtt_us as f64 + (offset_us - there).abs() + unsure * age_us
        });
        let least = bounds.fold(f64::INFINITY, f64::min);
        Span::from_micros(least.ceil() as i64)
    }

    /// How often one of the two clocks was set so far that the estimate began anew.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// The map in force; `None` until locked.
    pub fn map(&self) -> Option<ClockMap> {
        self.map
    }

    /// The newest round trip time.
    pub fn rtt(&self) -> Option<Span> {
        self.recent.back().map(|m| Span::from_micros(m.rtt_us))
    }
}

#[cfg(test)]
mod tests;
