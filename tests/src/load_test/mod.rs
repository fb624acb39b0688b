//! Load test: many participants of one session move their tools and solve no tissue. It measures the
//! server's load with the product's room and solver.
//!
//! [`LoadTest::run`] uses virtual time and an emulated network on one thread. Work is measured in CPU time, so
//! other processes do not affect the figures. The [real load test](real) starts a server process and one
//! QUIC connection per participant.

mod member;
pub mod real;

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::Span;
use palpate_server::host::solver_limit;
use palpate_tissue::{Model, Topology};

use crate::network::{Direction, Profile};
use crate::simulated_session::host::{Host, Round, room_config};
use crate::simulated_session::simulation::{Participant, Simulation};
use crate::simulated_session::{SiteClock, adaptive};
use crate::tool_location::{SurfacePoint, ToolLocation};
use member::{Member, Motion};

/// Limit for all participants to join, µs.
const IN_WITHIN_US: i64 = 10_000_000;

/// Time before the measurement, µs: clocks lock, delays settle and baselines are acknowledged.
const SETTLE_US: i64 = 1_000_000;

/// One of this many participants touches the tissue, and always at least one.
const ONE_TOUCHES_OF: usize = 4;

/// Initial and maximum delay of adaptive compensation, µs: the defaults of the host.
const DELAY_US: u32 = 10_000;
const DELAY_CAP_US: u32 = 400_000;

pub fn touching(participants: usize) -> usize {
    (participants / ONE_TOUCHES_OF).max(1).min(participants)
}

pub(crate) fn motions(model: &Arc<Model>, n: usize, seed: u64) -> Result<Vec<Motion>, String> {
    let topology = Topology::new(Arc::clone(model));
    let spots = ToolLocation::spread(&topology, n)?;
    // The first points are the farthest apart, so the touching participants are spread as well.
    let of = |k: usize| -> SurfacePoint { spots[k % spots.len()] };
    let motion = |k: usize| Motion::new(of(k), k < touching(n), seed.wrapping_add(k as u64));
    Ok((0..n).map(motion).collect())
}

#[derive(Debug, Clone)]
pub struct LoadTest<'a> {
    pub model: &'a Arc<Model>,
    pub participants: usize,
    pub profile: &'a Profile,
    pub seed: u64,
    pub seconds: f64,
    pub tick_hz: u32,
}

#[derive(Debug, Clone)]
pub struct LoadTestResult {
    pub rounds: Vec<Round>,
    pub seconds: f64,
    /// Uplink and downlink bytes of all participants, without QUIC overhead.
    pub bytes: [u64; 2],
    pub troubles: Vec<String>,
}

impl LoadTest<'_> {
    pub fn run(&self, mut progress: impl FnMut(f64)) -> Result<LoadTestResult, String> {
        let n = self.participants;
        let compensation = adaptive(DELAY_US, DELAY_CAP_US);
        let config = room_config(n, self.tick_hz, compensation, 0);
        let tick = Duration::from_micros(config.tick_period().as_micros().unsigned_abs());
        let limit = Span::from_micros(solver_limit(tick).as_micros() as i64);
        let host = Host::new(Arc::clone(self.model), config, Some(limit));
        let mut simulation = Simulation::new(host, &vec![self.profile; n], self.seed);
        let mut members = Vec::new();
        for (seat, motion) in motions(self.model, n, self.seed)?.into_iter().enumerate() {
            members.push(Member::new(seat, motion, SiteClock::of(self.seed, seat))?);
        }
        let mut counted_from = None::<i64>;
        loop {
            let at_us = simulation.at_us;
            let end = counted_from.map(|from| from + (self.seconds * 1e6) as i64);
            if end.map_or(at_us > IN_WITHIN_US, |end| at_us >= end) {
                break;
            }
            let participants = members.iter_mut().map(|m| m as &mut dyn Participant);
            simulation.turn(&mut participants.collect::<Vec<_>>());
            if counted_from.is_none_or(|from| at_us == from) {
                simulation.host.count_from_here();
                simulation.links.restart_log();
                if counted_from.is_none() && members.iter().all(Member::is_settled) {
                    counted_from = Some(at_us + SETTLE_US);
                }
            }
            if at_us % 100_000 == 0 {
                progress(end.map_or(0.0, |end| at_us as f64 / end as f64));
            }
            simulation.advance();
        }
        let troubles = members.into_iter().filter_map(|m| m.endpoint.trouble);
        let mut troubles: Vec<String> = troubles.collect();
        if counted_from.is_none() {
            troubles.push("not all participants joined within 10 s of simulated time".to_owned());
        }
        let links = &simulation.links;
        let bytes = [Direction::Up, Direction::Down].map(|d| links.bytes_sent(d, n));
        Ok(LoadTestResult {
            rounds: simulation.host.into_rounds(),
            seconds: self.seconds,
            bytes,
            troubles,
        })
    }
}

#[cfg(test)]
mod tests;
