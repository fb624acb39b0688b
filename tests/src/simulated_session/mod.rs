//! Simulated sessions: the product's parts over an emulated network, in virtual time.
//!
//! ```text
//! participant       link                        host
//!
//! hand, site  ----> uplink: path, stream   ---->  peer, room, tissue
//! session     <---- downlink: path, stream <----
//! ```
//!
//! `Simulation::turn` advances host and participants by 1 ms. Packets in flight are events of one queue, and each
//! is delivered at its own time.
//!
//! | simulation | participants | host |
//! | --- | --- | --- |
//! | [`SimulatedSession`] | trainees (hand, force loop, tissue; or motion only) and thin spectators | its work takes no time |
//! | `LoadTest` | members, motion only | its work takes CPU time |
//! | [`Alignment`](crate::alignment::Alignment) | two sites: hand, clock, delay estimate, timelines | playout delay of the group, or a prediction |
//!
//! An alignment has the links and clocks of the others, and no room: its subject is time compensation alone.
//!
//! A run uses no threads and no wall clock. A session solves by iterations and residual, so a seed reproduces it
//! exactly. Overload of a slow machine is not simulated; the [real session](crate::session) covers it.

pub(crate) mod endpoint;
pub(crate) mod host;
pub(crate) mod links;
mod mishap;
pub(crate) mod simulation;
mod site_clock;
mod thin_spectator;
mod trainee;

use std::sync::Arc;

use palpate_client::Recording;
use palpate_device::Script;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_room::LimitCounters;
use palpate_site::SiteCounters;
use palpate_tissue::Model;
use serde::Serialize;

use crate::network::{Direction, Profile};
use crate::stalls::Stalls;
use host::{Host, room_config};
use simulation::{Participant, Simulation};
use thin_spectator::ThinSpectator;
use trainee::Trainee;

pub use links::{Part, Sent};
pub use mishap::SessionFault;
pub(crate) use site_clock::SiteClock;
pub use thin_spectator::ThinSpectatorResult;

/// Limit for the start of the scripts, µs.
const BEGIN_WITHIN_US: i64 = 20_000_000;

/// Time after the scripts in which packets in flight arrive and are shown, µs.
const SETTLE_US: i64 = 1_500_000;

#[derive(Debug, Clone)]
pub struct SimulatedSession<'a> {
    pub model: &'a Arc<Model>,
    /// One trainee per script, named by its index.
    pub scripts: &'a [&'a Script],
    /// Trainees only move; they render no force and solve no tissue. This is faster where only the server's
    /// shape counts.
    pub motion_only: bool,
    pub thin_spectator_count: usize,
    pub profile: &'a Profile,
    pub seed: u64,
    pub compensation: CompensationSettings,
    pub tick_hz: u32,
}

/// Adaptive compensation with this initial and maximum delay, µs.
pub fn adaptive(initial_delay_us: u32, cap_us: u32) -> CompensationSettings {
    CompensationSettings {
        mode: CompensationMode::Adaptive { cap_us },
        initial_delay_us,
    }
}

/// Mean UDP payload of one participant, bytes/s, without QUIC overhead.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct BytesPerSecond {
    pub up: f64,
    pub down: f64,
}

#[derive(Debug, Clone)]
pub struct SessionResult {
    /// Recording of each trainee, in true time.
    pub recordings: Vec<Recording>,
    pub thin_results: Vec<ThinSpectatorResult>,
    /// Version and hash of the topology: first the server's, then each participant's.
    pub topologies: Vec<(u32, u64)>,
    pub counters: Vec<SiteCounters>,
    pub demotions: u64,
    /// How often each limit of the room took effect.
    pub limits: LimitCounters,
    /// Mean over the trainees, from the start of the scripts.
    pub bytes_per_s: BytesPerSecond,
    /// Every packet from the start of the scripts.
    pub sent: Vec<Sent>,
    /// Stalls of the network between trainees.
    pub stalls: Stalls,
    /// Time from the start of the scripts, s.
    pub seconds: f64,
    /// Errors of the run; empty on success.
    pub troubles: Vec<String>,
}

impl SessionResult {
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

    pub fn run_with(
        &self,
        session_faults: &[SessionFault],
        mut progress: impl FnMut(f64) -> bool,
    ) -> Result<SessionResult, String> {
        let trainee_count = self.scripts.len();
        let seats = trainee_count + self.thin_spectator_count;
        let config = room_config(seats, self.tick_hz, self.compensation, trainee_count);
        let host = Host::new(Arc::clone(self.model), config, None);
        let mut simulation = Simulation::new(host, &self.profiles(session_faults), self.seed);
        let mut trainees = Vec::new();
        for (seat, script) in self.scripts.iter().enumerate() {
            let clock = SiteClock::of(self.seed, seat);
            let mut trainee = Trainee::new(seat, Arc::clone(self.model), script, clock)?;
            let of_seat = session_faults.iter().filter(|m| m.seat() == seat);
            trainee.session_faults = of_seat.cloned().collect();
            trainee.solves = !self.motion_only;
            trainees.push(trainee);
        }
        let thin_spectator = |seat| {
            let clock = SiteClock::of(self.seed, seat);
            ThinSpectator::new(seat, Arc::clone(self.model), clock)
        };
        let mut thin_spectators: Vec<ThinSpectator> = (trainee_count..seats)
            .map(thin_spectator)
            .collect::<Result<_, _>>()?;
        let script_us = self.scripts.iter().map(|s| s.end_s()).fold(0.0, f64::max) * 1e6;
        let mut began_us = None::<i64>;
        loop {
            simulation.turn(&mut everyone(&mut trainees, &mut thin_spectators));
            let at_us = simulation.at_us;
            if began_us.is_none() {
                began_us = trainees.iter().find_map(|t| t.recording.script_started_us);
                simulation.links.restart_log();
            }
            let end_us = began_us.map(|b| b + script_us as i64 + SETTLE_US);
            if trainees.iter().any(|t| t.endpoint.trouble.is_some())
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
            simulation.advance();
        }
        let Simulation {
            host,
            mut links,
            at_us,
        } = simulation;
        let participants = everyone(&mut trainees, &mut thin_spectators).into_iter();
        let mut troubles: Vec<String> = participants
            .filter_map(|p| p.endpoint().trouble.take())
            .collect();
        if began_us.is_none() {
            troubles.push("the scripts did not start within 20 s of simulated time".to_owned());
        }
        let seconds = (at_us - began_us.unwrap_or(0)) as f64 * 1e-6;
        let share = 1.0 / (seconds.max(1e-3) * trainees.len().max(1) as f64);
        let (version, hash) = host.room.topology();
        let own = trainees.iter().filter_map(Trainee::topology);
        let own = own.chain(thin_spectators.iter().filter_map(ThinSpectator::topology));
        let topologies = std::iter::once((version, hash.0)).chain(own).collect();
        let last = host.pictures.last_key_value().map(|(_, p)| p.as_ref());
        let counters = trainees.iter().map(Trainee::counters).collect();
        let recordings: Vec<Recording> = trainees.into_iter().map(|t| t.recording).collect();
        let bytes = |direction| links.bytes_sent(direction, trainee_count) as f64 * share;
        let bytes_per_s = BytesPerSecond {
            up: bytes(Direction::Up),
            down: bytes(Direction::Down),
        };
        let sent = links.take_log();
        Ok(SessionResult {
            thin_results: thin_spectators
                .iter_mut()
                .map(|t| t.result(at_us, last))
                .collect(),
            topologies,
            counters,
            demotions: host.room.demotion_count(),
            limits: host.limits(),
            stalls: Stalls::between(&sent, &recordings),
            recordings,
            bytes_per_s,
            sent,
            seconds,
            troubles,
        })
    }

    fn profiles<'a>(&'a self, session_faults: &'a [SessionFault]) -> Vec<&'a Profile> {
        let mut profiles = vec![self.profile; self.scripts.len() + self.thin_spectator_count];
        for mishap in session_faults {
            if let SessionFault::Network { seat, profile } = mishap {
                profiles[*seat] = profile;
            }
        }
        profiles
    }
}

/// All participants in the order of their seats.
fn everyone<'a>(
    trainees: &'a mut [Trainee],
    thin_spectators: &'a mut [ThinSpectator],
) -> Vec<&'a mut dyn Participant> {
    let trainees = trainees.iter_mut().map(|t| t as &mut dyn Participant);
    let thin_spectators = thin_spectators
        .iter_mut()
        .map(|t| t as &mut dyn Participant);
    trainees.chain(thin_spectators).collect()
}

#[cfg(test)]
mod tests;
