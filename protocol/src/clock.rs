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
//! Queues only ever add to r, so that the θ of the smallest r within the last [`WINDOW`] is the
//! best one. The smallest of each second is kept for [`DRIFT_WINDOW`]; the slope of a straight line
//! through those, weighted by `1 / (r - r_min + 1 ms)²`, is the drift ρ. From the first lock on, the
//! map never steps: what it lacks is made up at a rate of at most [`SLEW_MAX`].

use std::collections::VecDeque;

use crate::datagram::{Probe, Reply};
use crate::{ClientTime, ServerTime, Span};

/// How far back the smallest round trip is looked for.
pub const WINDOW: Span = Span::from_millis(4000);

/// How far back the drift is fitted: long, because a jitter of 1 ms over 4 s looks like 250 ppm.
pub const DRIFT_WINDOW: Span = Span::from_millis(40_000);

/// The least history that gives a drift; before, it counts as none.
const DRIFT_MIN: Span = Span::from_millis(10_000);

/// The largest rate of the map against the client's clock. Crystals differ by 100 ppm at most, so
/// that it can follow any, and 500 ppm can be seen by nobody.
pub const SLEW_MAX: f64 = 500e-6;

/// What is lacking is made up within this time, if the slew allows.
const SETTLE_US: f64 = 2e6;

/// Answers before the first lock: at 20 ms between probes, 0.16 s and a round trip.
pub const LOCK_REPLIES: usize = 8;

/// Measurements kept; at 10 Hz the window needs 40.
const KEPT_MAX: usize = 256;

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

#[derive(Debug, Clone, Copy)]
struct Measurement {
    at: ClientTime,
    rtt_us: i64,
    offset_us: f64,
}

/// The estimate of the server's clock. Calling order: [`probe`](Self::probe) makes a probe to
/// send; [`handle_reply`](Self::handle_reply) takes its answer and gives the new map.
#[derive(Debug, Clone, Default)]
pub struct ClockEstimate {
    last_probe: u32,
    recent: VecDeque<Measurement>,
    best_of_seconds: VecDeque<Measurement>,
    map: Option<ClockMap>,
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
        let known = reply.id <= self.last_probe && reply.client_sent <= now;
        if !known || at_server < 0 || rtt_us < 0 || up_and_down > WINDOW.as_micros() {
            return None;
        }
        let up = reply
            .server_received
            .as_micros()
            .saturating_sub(reply.client_sent.as_micros());
        let down = reply
            .server_sent
            .as_micros()
            .saturating_sub(now.as_micros());
        let measurement = Measurement {
            at: reply.client_sent + Span::from_micros(up_and_down / 2),
            rtt_us,
            offset_us: up.midpoint(down) as f64,
        };
        self.remember(measurement, now);
        if self.map.is_none() && self.recent.len() < LOCK_REPLIES {
            return None;
        }
        self.update(now)
    }

    fn remember(&mut self, m: Measurement, now: ClientTime) {
        while self.recent.len() == KEPT_MAX
            || self.recent.front().is_some_and(|old| now - old.at > WINDOW)
        {
            self.recent.pop_front();
        }
        self.recent.push_back(m);
        let second = |m: &Measurement| m.at.as_micros().div_euclid(1_000_000);
        match self.best_of_seconds.back_mut() {
            Some(best) if second(best) == second(&m) => {
                if m.rtt_us < best.rtt_us {
                    *best = m;
                }
            }
            _ => self.best_of_seconds.push_back(m),
        }
        while self
            .best_of_seconds
            .front()
            .is_some_and(|old| now - old.at > DRIFT_WINDOW)
        {
            self.best_of_seconds.pop_front();
        }
    }

    /// The drift ρ of the server's clock against one's own.
    fn drift(&self) -> f64 {
        let (Some(first), Some(last)) = (self.best_of_seconds.front(), self.best_of_seconds.back())
        else {
            return 0.0;
        };
        if last.at - first.at < DRIFT_MIN {
            return 0.0;
        }
        let rtt_min = self
            .best_of_seconds
            .iter()
            .map(|m| m.rtt_us)
            .min()
            .unwrap_or(0);
        let (mut sw, mut sx, mut sy) = (0.0, 0.0, 0.0);
        let points = self.best_of_seconds.iter().map(|m| {
            let w = 1.0 / ((m.rtt_us - rtt_min) as f64 + 1000.0).powi(2);
            let x = (m.at - first.at).as_micros() as f64;
            (w, x, m.offset_us - first.offset_us)
        });
        for (w, x, y) in points.clone() {
            sw += w;
            sx += w * x;
            sy += w * y;
        }
        let (x_mean, y_mean) = (sx / sw, sy / sw);
        let (mut sxx, mut sxy) = (0.0, 0.0);
        for (w, x, y) in points {
            sxx += w * (x - x_mean).powi(2);
            sxy += w * (x - x_mean) * (y - y_mean);
        }
        if sxx > 0.0 {
            (sxy / sxx).clamp(-SLEW_MAX, SLEW_MAX)
        } else {
            0.0
        }
    }

    fn update(&mut self, now: ClientTime) -> Option<ClockMap> {
        let best = self
            .recent
            .iter()
            .min_by_key(|m| (m.rtt_us, -m.at.as_micros()))?;
        let drift = self.drift();
        let target_us = best.offset_us + drift * (now - best.at).as_micros() as f64;
        let (offset_us, rate) = match &self.map {
            None => (target_us, drift),
            Some(map) => {
                let offset_us = map.offset_at(now);
                let lacking = (target_us - offset_us) / SETTLE_US;
                (offset_us, (drift + lacking).clamp(-SLEW_MAX, SLEW_MAX))
            }
        };
        let lacking = Span::from_micros((target_us - offset_us).abs().round() as i64);
        let error_bound = Span::from_micros(best.rtt_us / 2) + lacking;
        self.map = Some(ClockMap {
            anchor: now,
            offset_us,
            rate,
            error_bound,
        });
        self.map
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
mod tests {
    use super::*;
    use rand::{Rng, RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    const TRUE_OFFSET_US: i64 = 123_456_789;

    /// Runs probes over a path with 30 ms base delay and up to `jitter_us` more each way, against a
    /// server clock that drifts.
    fn run(
        rng: &mut impl Rng,
        seconds: i64,
        drift: f64,
        jitter_us: i64,
        mut check: impl FnMut(i64, &ClockMap, f64),
    ) {
        let mut clock = ClockEstimate::new();
        let server = |c_us: i64| c_us + TRUE_OFFSET_US + (drift * c_us as f64) as i64;
        for i in 0..seconds * 10 {
            let t0 = i * 100_000;
            let probe = clock.probe(ClientTime::from_micros(t0));
            let t1 = t0 + 30_000 + rng.random_range(0..=jitter_us);
            let t2 = t1 + 200;
            let t3 = t2 + 30_000 + rng.random_range(0..=jitter_us);
            let reply = Reply {
                id: probe.id,
                client_sent: probe.client_sent,
                server_received: ServerTime::from_micros(server(t1)),
                server_sent: ServerTime::from_micros(server(t2)),
            };
            if let Some(map) = clock.handle_reply(reply, ClientTime::from_micros(t3)) {
                let known = map.to_server(ClientTime::from_micros(t3)).as_micros();
                check(t3, &map, (known - server(t3)) as f64);
            }
        }
    }

    #[test]
    fn the_error_stays_below_the_bound_and_below_half_the_round_trip() {
        for seed in 0..8 {
            let mut rng = Pcg64::seed_from_u64(seed);
            run(&mut rng, 60, 60e-6, 20_000, |_, map, error_us| {
                assert!(
                    error_us.abs() <= map.error_bound().as_micros() as f64 + 1.0,
                    "{error_us}"
                );
                assert!(error_us.abs() < 30_000.0);
            });
        }
    }

    #[test]
    fn drift_is_followed_without_a_step() {
        let mut rng = Pcg64::seed_from_u64(7);
        let mut last: Option<(i64, ClockMap)> = None;
        let mut worst_late = 0.0_f64;
        run(&mut rng, 120, -80e-6, 10_000, |t3, map, error_us| {
            let here = ClientTime::from_micros(t3);
            if let Some((_, before)) = last {
                let step = (map.to_server(here) - before.to_server(here)).as_micros();
                assert!(step.abs() <= 1, "a step of {step} µs");
            }
            assert!(map.rate.abs() <= SLEW_MAX);
            last = Some((t3, *map));
            if t3 > 60_000_000 {
                worst_late = worst_late.max(error_us.abs());
            }
        });
        assert!(worst_late < 3000.0, "{worst_late} µs with 10 ms of jitter");
    }

    #[test]
    fn to_client_is_the_inverse_of_to_server() {
        let map = ClockMap {
            anchor: ClientTime::from_micros(5_000_000),
            offset_us: -3e6,
            rate: 4e-4,
            error_bound: Span::ZERO,
        };
        for us in [0, 5_000_000, 77_777_777] {
            let t = ClientTime::from_micros(us);
            assert!((map.to_client(map.to_server(t)) - t).as_micros().abs() <= 1);
        }
    }

    #[test]
    fn an_answer_that_nobody_asked_for_is_ignored() {
        let mut clock = ClockEstimate::new();
        let now = ClientTime::from_micros(1_000_000);
        let reply = Reply {
            id: 9,
            client_sent: now,
            server_received: ServerTime::ZERO,
            server_sent: ServerTime::ZERO,
        };
        assert_eq!(clock.handle_reply(reply, now), None);
        assert_eq!(clock.rtt(), None);
    }
}
