//! Bandwidth of a full subscriber's session while trainees press and cut, per direction and part.
//!
//! Two trainees press, cut and press again in a [simulated session](crate::simulated_session), which records every
//! packet and its send time. The packets of each trainee are then sent again with equal lengths at equal times
//! over a real connection through a relay; this measures the overhead of QUIC. The model download is excluded.

use std::fmt;
use std::sync::Arc;

use clap::Args;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use palpate_server::host::TICK_HZ;
use palpate_tissue::Model;
use serde::Serialize;

use super::{Benchmark, quic};
use crate::network::{Direction, Profile};
use crate::progress::Progress;
use crate::scripts::{SECONDS_MIN, Scripts};
use crate::simulated_session::{Part, Sent, SessionResult, SimulatedSession};
use crate::test_model::TestModel;

/// Maximum bandwidth of a full subscriber, kbit/s of UDP payload, uplink and downlink.
pub const LIMIT_KBIT_S: [f64; 2] = [100.0, 150.0];

/// Initial and maximum delay of the compensation, µs: the defaults of a host.
const DELAY_US: u32 = 60_000;
const DELAY_CAP_US: u32 = 400_000;

/// Options of the bench.
#[derive(Debug, Clone, Args)]
pub struct Bytes {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(long, default_value = "thigh")]
    pub model: String,
    /// Length of the scripts, s: presses, a cut, presses
    #[arg(long, default_value_t = 8.0, value_name = "S")]
    pub seconds: f64,
    /// The network between the server and each trainee
    #[arg(long, default_value = "metro", value_parser = Profile::parse)]
    pub profile: Profile,
    /// Seed of packet fates and clocks
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

impl Benchmark for Bytes {
    type Report = BytesReport;

    fn measure(&self, progress: &mut Progress) -> Result<BytesReport, String> {
        if !(SECONDS_MIN..=60.0).contains(&self.seconds) {
            return Err(format!(
                "--seconds {} must be from {SECONDS_MIN} to 60",
                self.seconds
            ));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        self.run(&model, &mut |what| progress.tick(what))
    }
}

/// One direction of one session, kbit/s.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Flow {
    /// Uplink or downlink.
    pub direction: &'static str,
    /// Tool motion.
    pub motion: f64,
    /// The operations stream.
    pub operations: f64,
    /// Node corrections.
    pub corrections: f64,
    /// Clock requests and responses.
    pub clock: f64,
    /// Delay reports of participants, and heartbeats.
    pub delays: f64,
    /// Share of acknowledgements in all of these.
    pub acknowledgements: f64,
    /// Overhead of QUIC: headers, encryption tags, acknowledgements.
    pub quic: f64,
    /// Total UDP payload.
    pub udp: f64,
    /// UDP packets per second.
    pub packets_per_s: f64,
    /// Peak over one second, without the overhead of QUIC.
    pub worst_second: f64,
    /// Limit.
    pub limit: f64,
    /// Whether the total is within the limit.
    pub ok: bool,
}

/// One session.
#[derive(Debug, Clone, Serialize)]
pub struct Subscriber {
    /// Actions of the trainee.
    pub does: &'static str,
    /// Uplink, then downlink.
    pub flows: [Flow; 2],
}

/// Result.
#[derive(Debug, Clone, Serialize)]
pub struct BytesReport {
    /// Nodes of the model.
    pub nodes: usize,
    /// The network.
    pub network: String,
    /// Length of the scripts including the settling time, s.
    pub seconds: f64,
    /// Origin of the figures.
    pub method: &'static str,
    /// The holder (presses and holds), then the cutter (presses, cuts and presses).
    pub subscribers: Vec<Subscriber>,
    /// Whether both trainees are within the limits.
    pub ok: bool,
}

impl Bytes {
    /// Runs the measurement.
    pub fn run(
        &self,
        model: &Arc<Model>,
        progress: &mut dyn FnMut(&str),
    ) -> Result<BytesReport, String> {
        let scripts = Scripts::for_model(model, self.seconds)?;
        let session = SimulatedSession {
            model,
            scripts: &[&scripts.holder, &scripts.cutter],
            profile: &self.profile,
            seed: self.seed,
            compensation: CompensationSettings {
                mode: CompensationMode::Adaptive {
                    cap_us: DELAY_CAP_US,
                },
                initial_delay_us: DELAY_US,
            },
            tick_hz: TICK_HZ,
            thin_spectator_count: 0,
            motion_only: false,
        };
        let simulated = session.run(|done| {
            progress(&format!("simulating: {:3.0} %", done * 100.0));
            true
        })?;
        if let Some(trouble) = simulated.troubles.first() {
            return Err(format!("the simulated session failed: {trouble}"));
        }
        let mut subscribers = Vec::new();
        for (seat, does) in ["presses and holds", "presses, cuts and presses"]
            .into_iter()
            .enumerate()
        {
            progress(&format!("sending again over QUIC: the trainee that {does}"));
            subscribers.push(self.subscriber(&simulated, seat, does)?);
        }
        let ok = subscribers.iter().flat_map(|s| &s.flows).all(|f| f.ok);
        Ok(BytesReport {
            nodes: model.nodes.len(),
            network: self.profile.name.clone(),
            seconds: simulated.seconds,
            method: "packets of a simulated session; QUIC overhead measured by sending the same lengths at the same \
                     times over quinn through a relay",
            subscribers,
            ok,
        })
    }

    fn subscriber(
        &self,
        simulated: &SessionResult,
        seat: usize,
        does: &'static str,
    ) -> Result<Subscriber, String> {
        let own = simulated.sent.iter().filter(|s| s.seat == seat);
        let own: Vec<Sent> = own.copied().collect();
        let udp = quic::send_again(&own, &self.profile, self.seed)?;
        let seconds = simulated.seconds;
        let flow = |k: usize| {
            let direction = [Direction::Up, Direction::Down][k];
            Flow::of(&own, direction, seconds, udp[k], LIMIT_KBIT_S[k])
        };
        Ok(Subscriber {
            does,
            flows: [flow(0), flow(1)],
        })
    }
}

impl Flow {
    fn of(sent: &[Sent], direction: Direction, seconds: f64, udp: quic::Added, limit: f64) -> Self {
        let kbit = |bytes: f64| bytes * 8e-3 / seconds;
        let this: Vec<&Sent> = sent.iter().filter(|s| s.direction == direction).collect();
        let part = |part: Part| {
            let of = this.iter().filter(|s| s.part == part);
            kbit(of.map(|s| f64::from(s.bytes)).fold(0.0, |a, b| a + b))
        };
        let acknowledgements = this.iter().map(|s| f64::from(s.acknowledgement)).sum();
        let mut by_second = std::collections::BTreeMap::<u64, f64>::new();
        for packet in &this {
            *by_second.entry(packet.at_us / 1_000_000).or_default() += f64::from(packet.bytes);
        }
        let worst = by_second.values().copied().fold(0.0, f64::max) * 8e-3;
        let own: f64 = Part::ALL.into_iter().map(part).sum();
        let quic = kbit(udp.bytes);
        Self {
            direction: match direction {
                Direction::Up => "up",
                Direction::Down => "down",
            },
            motion: part(Part::Motion),
            operations: part(Part::Operations),
            corrections: part(Part::Corrections),
            clock: part(Part::Clock),
            delays: part(Part::Delays),
            acknowledgements: kbit(acknowledgements),
            quic,
            udp: own + quic,
            packets_per_s: udp.packets / seconds,
            worst_second: worst,
            limit,
            ok: own + quic <= limit,
        }
    }
}

impl fmt::Display for BytesReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} nodes, network {}, {:.1} s; kbit/s\n{}\n",
            self.nodes, self.network, self.seconds, self.method
        )?;
        write!(f, "{:<28}{:<6}", "", "")?;
        for head in [
            "motion",
            "operations",
            "corrections",
            "clock",
            "delays",
            "(acks)",
            "QUIC",
            "UDP",
            "limit",
            "packets/s",
        ] {
            write!(f, "{head:>12}")?;
        }
        for subscriber in &self.subscribers {
            for flow in &subscriber.flows {
                write!(f, "\n{:<28}{:<6}", subscriber.does, flow.direction)?;
                let all = [
                    flow.motion,
                    flow.operations,
                    flow.corrections,
                    flow.clock,
                    flow.delays,
                    flow.acknowledgements,
                    flow.quic,
                    flow.udp,
                    flow.limit,
                    flow.packets_per_s,
                ];
                for kbit in all {
                    write!(f, "{kbit:>12.2}")?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(direction: Direction, part: Part, at_us: u64, bytes: u16) -> Sent {
        Sent {
            at_us,
            seat: 0,
            direction,
            part,
            acknowledgement: 6,
            bytes,
        }
    }

    #[test]
    fn parts_and_quic_overhead_add_up_to_the_total() {
        let packets = [
            sent(Direction::Up, Part::Motion, 0, 400),
            sent(Direction::Up, Part::Clock, 1_500_000, 100),
            sent(Direction::Down, Part::Motion, 0, 9000),
        ];
        let added = quic::Added {
            bytes: 500.0,
            packets: 4.0,
        };
        let flow = Flow::of(&packets, Direction::Up, 2.0, added, 4.0);
        assert!((flow.motion - 1.6).abs() < 1e-9 && (flow.clock - 0.4).abs() < 1e-9);
        assert!((flow.udp - 4.0).abs() < 1e-9 && flow.ok);
        assert!((flow.worst_second - 3.2).abs() < 1e-9);
        assert!((flow.packets_per_s - 2.0).abs() < 1e-9);
    }
}
