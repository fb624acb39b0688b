//! A simulated session: the product's room, protocol sessions, sites, force loops and simulated hands over
//! an emulated network, in virtual time.
//!
//! ```text
//! hand -> force loop -> session -> wires -> peer -> room        1 ms per turn
//!          ^ model      |                    operations, motion, corrections
//!         site <--------+<------ wires <-----+
//!    thin site <--------+<------ wires <-----+  displacements
//! ```
//!
//! A run uses no threads and no wall clock. Solves end by iterations and residual, so a seed reproduces the
//! session exactly. Overload of a slow machine is not simulated; the [real session](crate::session) covers
//! it.

pub(crate) mod clock;
mod host;
mod mishap;
mod thin_spectator;
mod trainee;
pub(crate) mod wires;

use std::sync::Arc;

use palpate_client::Recording;
use palpate_device::Script;
use palpate_protocol::operation::CompensationSettings;
use palpate_protocol::{Epoch, Grant, ModelHash, ModelInfo, ResumeToken, Role, ServerTime};
use palpate_room::RoomConfig;
use palpate_site::SiteCounters;
use palpate_tissue::Model;
use serde::Serialize;

use crate::network::{Direction, Profile};
use clock::SiteClock;
use host::Host;
use thin_spectator::ThinSpectator;
pub use thin_spectator::ThinSpectatorResult;
use trainee::Trainee;
use wires::{Arrived, Wires};

pub use mishap::Mishap;
pub use wires::{Part, Sent};

/// Simulation step, µs.
const TURN_US: i64 = 1000;

/// Limit for the start of the scripts, µs.
const BEGIN_WITHIN_US: i64 = 20_000_000;

/// Time after the scripts in which packets in flight arrive and are shown, µs.
const SETTLE_US: i64 = 1_500_000;

/// Configuration of a simulated session.
#[derive(Debug, Clone)]
pub struct SimulatedSession<'a> {
    /// The tissue.
    pub model: &'a Arc<Model>,
    /// One trainee per script, named by its index.
    pub scripts: &'a [&'a Script],
    /// Trainees only move; they render no force and solve no tissue. This is faster where only the server's
    /// shape counts.
    pub motion_only: bool,
    /// Number of thin spectators.
    pub onlookers: usize,
    /// The network between the server and each participant.
    pub profile: &'a Profile,
    /// Seed of the networks and the clocks.
    pub seed: u64,
    /// Time compensation settings.
    pub compensation: CompensationSettings,
    /// Server ticks per second.
    pub tick_hz: u32,
}

/// Mean UDP payload of one participant, bytes/s, without QUIC overhead.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct BytesPerSecond {
    /// To the server.
    pub up: f64,
    /// From the server.
    pub down: f64,
}

/// Results of a simulated session.
#[derive(Debug, Clone)]
pub struct SessionResult {
    /// Recording of each trainee, in true time.
    pub recordings: Vec<Recording>,
    /// Results of each thin spectator.
    pub thin_results: Vec<ThinSpectatorResult>,
    /// Version and hash of the topology: first the server's, then each participant's.
    pub topologies: Vec<(u32, u64)>,
    /// Site counters of each trainee.
    pub counters: Vec<SiteCounters>,
    /// Number of demotions to spectator.
    pub demotions: u64,
    /// Mean over the trainees, from the start of the scripts.
    pub bytes_per_s: BytesPerSecond,
    /// Every packet from the start of the scripts.
    pub sent: Vec<Sent>,
    /// Time from the start of the scripts, s.
    pub seconds: f64,
    /// Errors of the run; empty on success.
    pub troubles: Vec<String>,
}

impl SessionResult {
    /// Whether all participants have the server's topology.
    pub fn hashes_equal(&self) -> bool {
        self.topologies.windows(2).all(|w| w[0] == w[1])
    }
}

impl SimulatedSession<'_> {
    /// Runs the session to the end of the longest script. `progress` receives the completed share;
    /// returning `false` interrupts the run.
    pub fn run(&self, progress: impl FnMut(f64) -> bool) -> Result<SessionResult, String> {
        self.run_with(&[], progress)
    }

    /// Like [`Self::run`], with injected faults.
    pub fn run_with(
        &self,
        mishaps: &[Mishap],
        mut progress: impl FnMut(f64) -> bool,
    ) -> Result<SessionResult, String> {
        let grant = Grant(*b"a rehearsal only");
        let trainee_count = self.scripts.len();
        let seats = trainee_count + self.onlookers;
        let mut wires = Wires::new(&self.profiles(mishaps), self.seed);
        let mut host = Host::new(Arc::clone(self.model), self.config(grant), seats);
        let mut trainees = Vec::new();
        for (seat, script) in self.scripts.iter().enumerate() {
            let name = format!("trainee-{}", seat + 1);
            let clock = SiteClock::of(self.seed, seat);
            let model = Arc::clone(self.model);
            let mut trainee = Trainee::new(seat, &name, grant, model, script, clock)?;
            let of_seat = mishaps.iter().filter(|m| m.seat() == seat);
            trainee.mishaps = of_seat.cloned().collect();
            trainees.push(if self.motion_only {
                trainee.only_moving()
            } else {
                trainee
            });
        }
        let thin_spectator = |seat| {
            let clock = SiteClock::of(self.seed, seat);
            ThinSpectator::new(seat, grant, Arc::clone(self.model), clock)
        };
        let mut thin_spectators: Vec<ThinSpectator> = (trainee_count..seats)
            .map(thin_spectator)
            .collect::<Result<_, _>>()?;
        let script_us = self.scripts.iter().map(|s| s.end_s()).fold(0.0, f64::max) * 1e6;
        let (mut at_us, mut began_us) = (0_i64, None::<i64>);
        loop {
            deliver(
                &mut host,
                &mut trainees,
                &mut thin_spectators,
                &mut wires,
                at_us,
            );
            host.turn(ServerTime::from_micros(at_us), &mut wires);
            for (seat, trainee) in trainees.iter_mut().enumerate() {
                if trainee.wants_connection() {
                    wires.renew(seat);
                    host.renew(seat, ServerTime::from_micros(at_us));
                    trainee.reconnect(at_us);
                }
                trainee.turn(at_us, &mut wires);
            }
            for (thin_spectator, seat) in thin_spectators.iter_mut().zip(trainee_count..) {
                let bytes = host.bytes_to(seat);
                thin_spectator.turn(at_us, &mut wires, bytes, host.pictures());
            }
            if began_us.is_none() {
                began_us = trainees.iter().find_map(|t| t.recording.script_started_us);
                wires.count_from_here();
            }
            let end_us = began_us.map(|b| b + script_us as i64 + SETTLE_US);
            if trainees.iter().any(|t| t.trouble.is_some())
                || end_us.map_or(at_us > BEGIN_WITHIN_US, |end| at_us >= end)
            {
                break;
            }
            if at_us % 50_000 == 0 {
                let share = end_us.map_or(0.0, |end| at_us as f64 / end as f64);
                if !progress(share) {
                    return Err("interrupted".to_owned());
                }
            }
            at_us += TURN_US;
        }
        let of_thin = thin_spectators.iter().filter_map(|t| t.trouble.clone());
        let mut troubles: Vec<String> = trainees.iter().filter_map(|t| t.trouble.clone()).collect();
        troubles.extend(of_thin);
        if began_us.is_none() {
            troubles.push("the scripts did not start within 20 s of simulated time".to_owned());
        }
        let seconds = (at_us - began_us.unwrap_or(0)) as f64 * 1e-6;
        let share = 1.0 / (seconds.max(1e-3) * trainees.len().max(1) as f64);
        let (version, hash) = host.topology();
        let own = trainees.iter().filter_map(Trainee::topology);
        let own = own.chain(thin_spectators.iter().filter_map(ThinSpectator::topology));
        let topologies = std::iter::once((version, hash.0)).chain(own).collect();
        let last = host.pictures().last_key_value().map(|(_, p)| p.as_ref());
        Ok(SessionResult {
            thin_results: thin_spectators
                .iter_mut()
                .map(|t| t.result(at_us, last))
                .collect(),
            topologies,
            counters: trainees.iter().map(Trainee::counters).collect(),
            demotions: host.demotions(),
            recordings: trainees.into_iter().map(|t| t.recording).collect(),
            bytes_per_s: BytesPerSecond {
                up: wires.counted(Direction::Up, trainee_count) as f64 * share,
                down: wires.counted(Direction::Down, trainee_count) as f64 * share,
            },
            sent: wires.take_sent(),
            seconds,
            troubles,
        })
    }

    /// The network profile of each seat.
    fn profiles<'a>(&'a self, mishaps: &'a [Mishap]) -> Vec<&'a Profile> {
        let mut profiles = vec![self.profile; self.scripts.len() + self.onlookers];
        for mishap in mishaps {
            if let Mishap::Network { seat, profile } = mishap {
                profiles[*seat] = profile;
            }
        }
        profiles
    }

    fn config(&self, grant: Grant) -> RoomConfig {
        RoomConfig {
            epoch: Epoch(1),
            model: ModelInfo {
                hash: ModelHash(0),
                bytes: 0,
            },
            grants: vec![(Role::Trainee, grant), (Role::Spectator, grant)],
            seats: (self.scripts.len() + self.onlookers) as u16,
            tick_hz: self.tick_hz,
            compensation: self.compensation,
            start_when_tools: self.scripts.len() as u16,
            // A predictable token is safe: the simulation has no attacker.
            fresh_token: |who| ResumeToken([who.0 as u8; 16]),
        }
    }
}

/// Delivers packets due by `at_us`, each at its arrival time. The server forwards them at once, as its
/// event loop does.
fn deliver(
    host: &mut Host,
    trainees: &mut [Trainee],
    thin_spectators: &mut [ThinSpectator],
    wires: &mut Wires,
    at_us: i64,
) {
    let trainee_count = trainees.len();
    while let Some((when_us, seat, direction, arrived)) = wires.pop_due(at_us.unsigned_abs()) {
        let when_us = when_us as i64;
        match (direction, arrived) {
            (Direction::Up, arrived) => {
                let then = ServerTime::from_micros(when_us);
                match arrived {
                    Arrived::Stream(bytes) => host.handle_stream(seat, &bytes, then),
                    Arrived::Datagram(bytes) => host.handle_datagram(seat, &bytes, then),
                }
                host.turn(then, wires);
            }
            (Direction::Down, arrived) if seat >= trainee_count => {
                let thin_spectator = &mut thin_spectators[seat - trainee_count];
                match arrived {
                    Arrived::Stream(bytes) => thin_spectator.handle_stream(&bytes, when_us),
                    Arrived::Datagram(bytes) => thin_spectator.handle_datagram(&bytes, when_us),
                }
            }
            (Direction::Down, Arrived::Stream(bytes)) => {
                trainees[seat].handle_stream(&bytes, when_us);
            }
            (Direction::Down, Arrived::Datagram(bytes)) => {
                trainees[seat].handle_datagram(&bytes, when_us);
            }
        }
    }
}

#[cfg(test)]
mod tests;
