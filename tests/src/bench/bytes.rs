//! Bandwidth of a full subscriber's session while trainees press and cut, per direction and part.
//!
//! Two trainees press, cut and press again in a [simulated session](crate::simulated_session), which records every
//! packet and its send time. The packets of each trainee are then sent again with equal lengths at equal times
//! over a real connection through a relay; this measures the overhead of QUIC. The model download is excluded.

use std::fmt;

use clap::{Args, ValueEnum};
use palpate_server::host::TICK_HZ;
use serde::Serialize;

use super::{Benchmark, OnStage, quic};
use crate::network::{Direction, Profile};
use crate::scripts::{SECONDS_MIN, Scripts};
use crate::simulated_session::{Part, Sent, SessionResult, SimulatedSession, adaptive};
use crate::test_model::TestModel;

/// Maximum bandwidth of a full subscriber, kbit/s of UDP payload, uplink and downlink.
pub const LIMIT_KBIT_S: [f64; 2] = [100.0, 150.0];

/// Initial and maximum delay of the compensation, µs: the defaults of a host.
const DELAY_US: u32 = 60_000;
const DELAY_CAP_US: u32 = 400_000;

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

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<BytesReport, String> {
        if !(SECONDS_MIN..=60.0).contains(&self.seconds) {
            return Err(format!(
                "--seconds {} must be from {SECONDS_MIN} to 60",
                self.seconds
            ));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        let scripts = Scripts::for_model(&model, self.seconds)?;
        let session = SimulatedSession {
            model: &model,
            scripts: &[&scripts.holder, &scripts.cutter],
            profile: &self.profile,
            seed: self.seed,
            compensation: adaptive(DELAY_US, DELAY_CAP_US),
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
}

/// One direction of one session, kbit/s.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Flow {
    pub direction: &'static str,
    pub motion: f64,
    pub operations: f64,
    pub corrections: f64,
    pub clock: f64,
    pub delays: f64,
    /// Share of acknowledgements in all of these.
    pub acknowledgements: f64,
    pub quic: f64,
    /// Total UDP payload.
    pub udp: f64,
    pub packets_per_s: f64,
    /// Peak over one second, without the overhead of QUIC.
    pub worst_second: f64,
    pub limit: f64,
    pub ok: bool,
}

#[derive(Debug, Clone, Serialize)]
pub struct Subscriber {
    pub does: &'static str,
    /// Uplink, then downlink.
    pub flows: [Flow; 2],
}

#[derive(Debug, Clone, Serialize)]
pub struct BytesReport {
    pub nodes: usize,
    pub network: String,
    /// Length of the scripts including the settling time, s.
    pub seconds: f64,
    pub method: &'static str,
    /// The holder (presses and holds), then the cutter (presses, cuts and presses).
    pub subscribers: Vec<Subscriber>,
    pub ok: bool,
}

impl Bytes {
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
    /// The columns of the text.
    fn cells(&self) -> [(&'static str, f64); 10] {
        [
            ("motion", self.motion),
            ("operations", self.operations),
            ("corrections", self.corrections),
            ("clock", self.clock),
            ("delays", self.delays),
            ("(acks)", self.acknowledgements),
            ("QUIC", self.quic),
            ("UDP", self.udp),
            ("limit", self.limit),
            ("packets/s", self.packets_per_s),
        ]
    }

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
        let own: f64 = Part::value_variants().iter().copied().map(part).sum();
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
        for (head, _) in self.subscribers[0].flows[0].cells() {
            write!(f, "{head:>12}")?;
        }
        for subscriber in &self.subscribers {
            for flow in &subscriber.flows {
                write!(f, "\n{:<28}{:<6}", subscriber.does, flow.direction)?;
                for (_, value) in flow.cells() {
                    write!(f, "{value:>12.2}")?;
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
            arrives_us: None,
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
