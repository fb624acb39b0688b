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
//! needs both at once: with 5 ms of jitter the middle is five times nearer to the truth (the strip is
//! the linear programme of Moon, Skelly and Towsley 1999, taken for both ways). Slower packets do not
//! touch it, so that a path may become slower and faster again. From the first lock on, the map never
//! steps: what it lacks is made up at a rate of at most [`SLEW_MAX`].
//!
//! A way that is always slower than the other can not be told from an offset: the bound says so. An
//! answer that no offset within the bounds explains means that one of the two clocks was set. After
//! [`STEP_REPLIES`] such answers the estimate begins anew, without a map until it is locked, and counts
//! it in [`ClockEstimate::steps`]: whoever is in contact must let go, because no rate leads there.

use std::collections::VecDeque;

use crate::datagram::{Probe, Reply};
use crate::{ClientTime, ServerTime, Span};

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

#[derive(Debug, Clone, Copy)]
struct Measurement {
    at: ClientTime,
    rtt_us: i64,
    /// t1 - t0: the offset and the way up.
    above_us: i64,
    /// t2 - t3: the offset less the way down.
    below_us: i64,
}

impl Measurement {
    /// θ, wrong by at most half the round trip.
    fn offset_us(&self) -> f64 {
        self.above_us.midpoint(self.below_us) as f64
    }
}

/// The widest strip between the two ways: at `origin`, on the slope.
#[derive(Debug, Clone, Copy)]
struct Strip {
    middle_us: f64,
    width_us: f64,
    slope: f64,
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

    /// The strip of one slope, at `origin`.
    fn strip(&self, origin: ClientTime, slope: f64) -> Strip {
        let (mut above_us, mut below_us) = (f64::INFINITY, f64::NEG_INFINITY);
        // Relative to one of them, so that hours of offset lose no digits.
        let reference = self.recent.back().map_or(0, |m| m.above_us);
        for m in &self.recent {
            let leaned = slope * (m.at - origin).as_micros() as f64;
            above_us = above_us.min(m.above_us.saturating_sub(reference) as f64 - leaned);
            below_us = below_us.max(m.below_us.saturating_sub(reference) as f64 - leaned);
        }
        Strip {
            middle_us: reference as f64 + 0.5 * (above_us + below_us),
            width_us: above_us - below_us,
            slope,
        }
    }

    /// The widest strip. Its width is concave in the slope (a least of straight lines less a
    /// greatest), so that thirds find it.
    fn widest_strip(&self, origin: ClientTime) -> Strip {
        const THIRDS: u32 = 18;
        let history = self.recent.back().zip(self.recent.front());
        if history.is_none_or(|(last, first)| last.at - first.at < DRIFT_MIN) {
            return self.strip(origin, 0.0);
        }
        let (mut low, mut high) = (-DRIFT_MAX, DRIFT_MAX);
        for _ in 0..THIRDS {
            let third = (high - low) / 3.0;
            let (a, b) = (low + third, high - third);
            if self.strip(origin, a).width_us < self.strip(origin, b).width_us {
                low = a;
            } else {
                high = b;
            }
        }
        self.strip(origin, 0.5 * (low + high))
    }

    fn update(&mut self, now: ClientTime) -> Option<ClockMap> {
        let strip = self.widest_strip(now);
        let target_us = strip.middle_us;
        let (offset_us, rate) = match &self.map {
            None => (target_us, strip.slope),
            Some(map) => {
                let offset_us = map.offset_at(now);
                let lacking = (target_us - offset_us) / SETTLE_US;
                (
                    offset_us,
                    (strip.slope + lacking).clamp(-SLEW_MAX, SLEW_MAX),
                )
            }
        };
        self.map = Some(ClockMap {
            anchor: now,
            offset_us,
            rate,
            error_bound: self.bound(now, offset_us, strip.slope),
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

    #[test]
    fn the_strip_is_nearer_than_the_fastest_round_trip_alone() {
        // Two people at 10 ms of jitter: what they see of one tool is as far apart as their clocks.
        for seed in 0..8 {
            let mut rng = Pcg64::seed_from_u64(seed);
            run(&mut rng, 60, 40e-6, 10_000, |t3, _, error_us| {
                if t3 > 20_000_000 {
                    assert!(error_us.abs() < 600.0, "{error_us} µs");
                }
            });
        }
    }

    #[test]
    fn a_clock_that_is_set_by_hours_begins_the_estimate_anew_and_is_counted() {
        for step_us in [7_200_000_000_i64, -7_200_000_000] {
            let mut clock = ClockEstimate::new();
            let (mut lost, mut wrong) = (0, 0);
            for i in 0..600 {
                let true_us = 10_000_000_000 + i * 100_000;
                let set_us = if i >= 300 { step_us } else { 0 };
                let probe = clock.probe(ClientTime::from_micros(true_us + set_us));
                let server = ServerTime::from_micros(true_us + 30_000);
                let reply = Reply {
                    id: probe.id,
                    client_sent: probe.client_sent,
                    server_received: server,
                    server_sent: server,
                };
                let here = ClientTime::from_micros(true_us + 60_000 + set_us);
                clock.handle_reply(reply, here);
                match clock.map() {
                    Some(map) => {
                        let error_us = map.to_server(here).as_micros() - true_us - 60_000;
                        wrong += i32::from(error_us.abs() > map.error_bound().as_micros());
                    }
                    None => lost += i32::from(i >= 300),
                }
            }
            assert_eq!(clock.steps(), 1);
            // Wrong only until the third answer says so; without a map until it is locked.
            assert!(wrong < STEP_REPLIES as i32, "{wrong}");
            assert!(lost <= LOCK_REPLIES as i32, "{lost}");
        }
    }

    #[test]
    fn one_damaged_answer_changes_nothing() {
        let mut clock = ClockEstimate::new();
        for i in 0..100 {
            let probe = clock.probe(ClientTime::from_micros(i * 100_000));
            let damage = if i == 50 { 9_000_000_000 } else { 0 };
            let server = ServerTime::from_micros(i * 100_000 + 30_000 + damage);
            let reply = Reply {
                id: probe.id,
                client_sent: probe.client_sent,
                server_received: server,
                server_sent: server,
            };
            clock.handle_reply(reply, ClientTime::from_micros(i * 100_000 + 60_000));
        }
        assert_eq!(clock.steps(), 0);
        let map = clock.map().unwrap();
        let t = ClientTime::from_micros(10_000_000);
        assert!((map.to_server(t).as_micros() - 10_000_000).abs() <= 1);
    }

    #[test]
    fn a_path_that_is_slower_one_way_stays_within_the_bound() {
        let mut clock = ClockEstimate::new();
        for i in 0..300 {
            let probe = clock.probe(ClientTime::from_micros(i * 100_000));
            let server = ServerTime::from_micros(i * 100_000 + 90_000);
            let reply = Reply {
                id: probe.id,
                client_sent: probe.client_sent,
                server_received: server,
                server_sent: server,
            };
            let here = ClientTime::from_micros(i * 100_000 + 100_000);
            if let Some(map) = clock.handle_reply(reply, here) {
                let error = map.to_server(here).as_micros() - here.as_micros();
                assert!(error.abs() <= map.error_bound().as_micros(), "{error}");
                assert!(error > 39_000, "the asymmetry can not be seen");
            }
        }
    }
}
