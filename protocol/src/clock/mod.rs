//! The client's estimate of the server's clock.
//!
//! A probe leaves the client at t0 and reaches the server at t1. The answer leaves at t2 and arrives at
//! t3 (t0, t3 on the client's clock, t1, t2 on the server's).
//!
//! ```text
//! r = (t3 - t0) - (t2 - t1)            round trip on the network
//! θ = ((t1 - t0) + (t2 - t3)) / 2      offset, wrong by at most r / 2
//! ```
//!
//! Queues only add delay, in either direction. The offset line θ(t) = a + ρ t therefore lies below every
//! `t1 - t0` and above every `t2 - t3`. The widest band of one slope ρ between both sets touches the
//! fastest packets of each direction: its slope is the drift, its middle the offset. Each direction
//! finds its own fastest packet, where the smallest round trip needs both at once: with 5 ms of jitter
//! the middle of the band is five times nearer to the truth. Moon, Skelly and Towsley (INFOCOM 1999)
//! estimate the skew of one direction by a linear programme: the nearest line under all delays. Using
//! both directions and the middle of the band is our own. Slower packets do not touch the band, so that
//! a path may become slower and faster again. Under jitter without a sharp minimum the mean of all
//! answers is more precise and counts instead (`line`). After the first lock corrections are slewed by
//! at most [`SLEW_MAX`].
//!
//! A constant asymmetry of the path can not be distinguished from an offset; the error bound includes
//! it. An answer that no offset within the bounds explains means that one of the two clocks was set, or that
//! the map was locked during a stall.
//! After [`STEP_REPLIES`] such answers the estimate restarts, without a map until it is locked, and
//! increments [`ClockEstimate::steps`]. A tool in contact must then let go, because no slew covers the
//! step.

mod line;

use std::collections::VecDeque;

use crate::datagram::{Probe, Reply};
use crate::{ClientTime, ServerTime, Span};
use line::{Answers, Measurement};

/// Answers with a longer round trip are ignored.
pub const WINDOW: Span = Span::from_millis(4000);

/// Length of the history: long, because a jitter of 1 ms over 4 s looks like 250 ppm.
pub const DRIFT_WINDOW: Span = Span::from_millis(40_000);

/// The largest drift that is searched: crystals are within 100 ppm, two of them within 200.
const DRIFT_MAX: f64 = 200e-6;

/// The error bound of the drift after [`DRIFT_MIN`]; before, the bound is [`DRIFT_MAX`].
const DRIFT_UNSURE: f64 = 30e-6;

/// Consecutive contradicting answers before a clock counts as set: a single one may be damaged.
pub const STEP_REPLIES: usize = 3;

/// The shortest history that gives a drift; before, the drift is zero.
const DRIFT_MIN: Span = Span::from_millis(5000);

/// The largest slew of the map against the client's clock. Crystals differ by 100 ppm at most, so that
/// the map can follow any, and 500 ppm is not visible.
pub const SLEW_MAX: f64 = 500e-6;

/// A correction is distributed over this time, if the slew limit allows.
const SETTLE_US: f64 = 2e6;

/// Answers before the first lock: at 20 ms between probes, 0.16 s and a round trip.
pub const LOCK_REPLIES: usize = 8;

/// Measurements kept; at 10 Hz [`DRIFT_WINDOW`] needs 400.
const KEPT_MAX: usize = 512;

/// Fractional part of the golden ratio, whose multiples are spread evenly.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// The map from the client's clock to the server's and back, valid until the next one replaces it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockMap {
    anchor: ClientTime,
    offset_us: f64,
    rate: f64,
    error_bound: Span,
}

impl ClockMap {
    /// An exact map: for a server that is its own client, and for tests.
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

    /// The server time of a moment on the client's clock.
    pub fn to_server(&self, t: ClientTime) -> ServerTime {
        ServerTime::from_micros(
            t.as_micros()
                .saturating_add(self.offset_at(t).round() as i64),
        )
    }

    /// The client time of a moment on the server's clock.
    pub fn to_client(&self, t: ServerTime) -> ClientTime {
        let at_anchor = self.anchor.as_micros() as f64 + self.offset_us;
        let since = (t.as_micros() as f64 - at_anchor) / (1.0 + self.rate);
        ClientTime::from_micros(self.anchor.as_micros().saturating_add(since.round() as i64))
    }

    /// The error bound of the map: half of the smallest round trip plus the correction still to be
    /// slewed. Path asymmetry can not be distinguished from an offset.
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
    /// Consecutive answers that contradict the map.
    contradicting: Vec<Measurement>,
    map: Option<ClockMap>,
    steps: u64,
}

impl ClockEstimate {
    /// An estimate without measurements.
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

    /// The time from the last probe to the next: half to three halves of a period, in a golden-ratio sequence. Probes in
    /// step with the schedule of a radio link would all wait equally long, and none would be fast.
    pub fn probe_pause(&self, period: Span) -> Span {
        let share = (f64::from(self.last_probe) * GOLDEN).fract();
        Span::from_micros((period.as_micros() as f64 * (0.5 + share)) as i64)
    }

    /// Takes an answer that arrived now. Returns `None` until the clock is locked, and for an answer
    /// that does not match a probe.
    pub fn handle_reply(&mut self, reply: Reply, now: ClientTime) -> Option<ClockMap> {
        let elapsed_us = (now - reply.client_sent).as_micros();
        let at_server = (reply.server_sent - reply.server_received).as_micros();
        let rtt_us = elapsed_us.saturating_sub(at_server);
        let known = reply.id <= self.last_probe;
        if !known || at_server < 0 {
            return None;
        }
        if reply.client_sent > now || rtt_us < 0 || elapsed_us > WINDOW.as_micros() {
            // The client's clock was set while the probe was under way, or the answer is very late: the
            // answer measures nothing.
            return None;
        }
        let measurement = Measurement {
            at: reply.client_sent + Span::from_micros(elapsed_us / 2),
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

    /// Whether no offset within the bounds explains a measurement, or none that the map reaches by slewing for
    /// [`DRIFT_WINDOW`]: a map that was locked during a stall can be wrong by half of it.
    fn contradicts(&self, m: &Measurement) -> bool {
        let far = |offset_us: f64, bound_us: f64| {
            (m.offset_us() - offset_us).abs() > bound_us + (m.rtt_us / 2 + 1) as f64
        };
        match (&self.map, self.recent.back()) {
            (Some(map), Some(last)) => {
                let since_us = (m.at - last.at).as_micros().unsigned_abs() as f64;
                let bound_us = map.error_bound.as_micros() as f64 + DRIFT_MAX * since_us;
                let slewed_us = SLEW_MAX * DRIFT_WINDOW.as_micros() as f64;
                far(map.offset_at(m.at), bound_us.min(slewed_us))
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

    /// The current error bound of the map: every measurement limits it. The newest does so by its round
    /// trip alone, older ones also by the largest drift since.
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

    /// How often the estimate restarted because one of the two clocks was set.
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
