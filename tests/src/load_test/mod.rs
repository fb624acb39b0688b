//! Load test: many participants of one session move their tools and solve no tissue. It measures the
//! server's load with the product's room and solver.
//!
//! [`LoadTest::run`] uses virtual time and an emulated network on one thread. Work is measured in CPU time, so
//! other processes do not affect the figures. The [real load test](real) starts a server process and one
//! QUIC connection per participant.

mod member;
pub mod real;
mod server;

use std::sync::Arc;

use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_protocol::{Epoch, Grant, ModelHash, ModelInfo, ResumeToken, Role, ServerTime};
use palpate_room::{RoomConfig, SimulatedRoom};
use palpate_tissue::{Model, Topology};

use crate::network::{Direction, Profile};
use crate::simulated_session::clock::SiteClock;
use crate::simulated_session::wires::{Arrived, Wires};
use crate::tool_location::{SurfacePoint, ToolLocation};
use member::{Member, Motion};
use server::Server;

pub use server::Round;

/// Simulation step, µs.
const TURN_US: i64 = 1000;

/// Limit for all participants to join, µs.
const IN_WITHIN_US: i64 = 10_000_000;

/// Time before the measurement, µs: clocks lock, delays settle and baselines are acknowledged.
const SETTLE_US: i64 = 1_000_000;

/// One of this many participants touches the tissue, and always at least one.
const ONE_TOUCHES_OF: usize = 4;

/// Initial and maximum delay of adaptive compensation, µs: the defaults of the host.
const DELAY_US: u32 = 10_000;
const DELAY_CAP_US: u32 = 400_000;

/// Number of participants that touch the tissue.
pub fn touching(participants: usize) -> usize {
    (participants / ONE_TOUCHES_OF).max(1).min(participants)
}

/// The motions of all participants, spread over the surface.
pub(crate) fn motions(model: &Arc<Model>, n: usize, seed: u64) -> Result<Vec<Motion>, String> {
    let topology = Topology::new(Arc::clone(model));
    let spots = ToolLocation::spread(&topology, n).map_err(|e| e.to_string())?;
    // The first points are the farthest apart, so the touching participants are spread as well.
    let of = |k: usize| -> SurfacePoint { spots[k % spots.len()] };
    let motion = |k: usize| Motion::new(of(k), k < touching(n), seed.wrapping_add(k as u64));
    Ok((0..n).map(motion).collect())
}

/// Configuration of a load test in virtual time.
#[derive(Debug, Clone)]
pub struct LoadTest<'a> {
    /// The tissue.
    pub model: &'a Arc<Model>,
    /// Number of participants.
    pub participants: usize,
    /// The network between the server and each participant.
    pub profile: &'a Profile,
    /// Seed of motions, clocks and networks.
    pub seed: u64,
    /// Measured time, s.
    pub seconds: f64,
    /// Ticks per second of the server.
    pub tick_hz: u32,
}

/// Results of a load test in virtual time.
#[derive(Debug, Clone)]
pub struct LoadTestResult {
    /// Cost of every server period.
    pub rounds: Vec<Round>,
    /// Measured time, s.
    pub seconds: f64,
    /// Uplink and downlink bytes of all participants, without QUIC overhead.
    pub bytes: [u64; 2],
    /// Errors of the run; empty on success.
    pub troubles: Vec<String>,
}

impl LoadTest<'_> {
    /// Runs the load test. `progress` receives the completed share.
    pub fn run(&self, mut progress: impl FnMut(f64)) -> Result<LoadTestResult, String> {
        let n = self.participants;
        let grant = Grant(*b"a rehearsal only");
        let config = self.config(grant);
        let room = SimulatedRoom::new(Arc::clone(self.model), config.clone(), ServerTime::ZERO);
        let mut server = Server::new(room, &config, n);
        let mut wires = Wires::new(&vec![self.profile; n], self.seed);
        let clocks: Vec<SiteClock> = (0..n).map(|k| SiteClock::of(self.seed, k)).collect();
        let mut members = Vec::new();
        for (k, motion) in motions(self.model, n, self.seed)?.into_iter().enumerate() {
            members.push(Member::new(k, grant, motion, clocks[k].at(0))?);
        }
        let (mut at_us, mut counted_from) = (0_i64, None::<i64>);
        loop {
            let end = counted_from.map(|from| from + (self.seconds * 1e6) as i64);
            if end.map_or(at_us > IN_WITHIN_US, |end| at_us >= end) {
                break;
            }
            deliver(&mut server, &mut members, &clocks, &mut wires, at_us);
            server.turn(ServerTime::from_micros(at_us), &mut wires);
            for (seat, member) in members.iter_mut().enumerate() {
                let now = clocks[seat].at(at_us);
                member.turn(now, at_us as f64 * 1e-6);
                while let Some(bytes) = member.session.poll_stream() {
                    wires.send_stream(seat, Direction::Up, &bytes, at_us.unsigned_abs());
                }
                while let Some(bytes) = member.session.poll_datagram(now) {
                    wires.send_datagram(seat, Direction::Up, bytes, at_us.unsigned_abs());
                }
            }
            if counted_from.is_none_or(|from| at_us == from) {
                server.count_from_here();
                wires.count_from_here();
                if counted_from.is_none() && members.iter().all(Member::is_settled) {
                    counted_from = Some(at_us + SETTLE_US);
                }
            }
            if at_us % 100_000 == 0 {
                progress(end.map_or(0.0, |end| at_us as f64 / end as f64));
            }
            at_us += TURN_US;
        }
        let mut troubles: Vec<String> = members.into_iter().filter_map(|m| m.trouble).collect();
        if counted_from.is_none() {
            troubles.push("not all participants joined within 10 s of simulated time".to_owned());
        }
        Ok(LoadTestResult {
            rounds: server.rounds,
            seconds: self.seconds,
            bytes: [Direction::Up, Direction::Down].map(|d| wires.counted(d, n)),
            troubles,
        })
    }

    fn config(&self, grant: Grant) -> RoomConfig {
        RoomConfig {
            epoch: Epoch(1),
            model: ModelInfo {
                hash: ModelHash(0),
                bytes: 0,
            },
            grants: vec![(Role::Trainee, grant)],
            seats: u16::try_from(self.participants).unwrap_or(u16::MAX),
            tick_hz: self.tick_hz,
            compensation: CompensationSettings {
                mode: CompensationMode::Adaptive {
                    cap_us: DELAY_CAP_US,
                },
                initial_delay_us: DELAY_US,
            },
            start_when_tools: 0,
            // A predictable token is safe: the simulation has no attacker.
            fresh_token: |who| ResumeToken([who.0 as u8; 16]),
        }
    }
}

/// Delivers the packets that are due.
fn deliver(
    server: &mut Server,
    members: &mut [Member],
    clocks: &[SiteClock],
    wires: &mut Wires,
    at_us: i64,
) {
    while let Some((when_us, seat, direction, arrived)) = wires.pop_due(at_us.unsigned_abs()) {
        let when_us = when_us as i64;
        match (direction, arrived) {
            (Direction::Up, arrived) => {
                server.handle(seat, &arrived, ServerTime::from_micros(when_us));
            }
            (Direction::Down, Arrived::Stream(bytes)) => {
                members[seat]
                    .session
                    .handle_stream(&bytes, clocks[seat].at(when_us));
            }
            (Direction::Down, Arrived::Datagram(bytes)) => {
                members[seat]
                    .session
                    .handle_datagram(&bytes, clocks[seat].at(when_us));
            }
        }
    }
}

#[cfg(test)]
mod tests;
