//! The figures of a run at its end, for people and as one JSON object.

use std::fmt;

use palpate_haptics::Counters;
use palpate_transport::threads::CpuUsage;
use serde::{Deserialize, Serialize};

use crate::realtime::{DeviceCounts, LoopStats, Percentiles};

/// The figures of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The participant's name.
    pub name: String,
    /// The word for the role.
    pub role: String,
    /// The word for what of the tissue was sent: full or thin.
    #[serde(default)]
    pub subscription: String,
    /// Everything that came from the server over the last connection, without the model, kbit/s of UDP payload.
    #[serde(default)]
    pub down_kbit_s: f64,
    /// The most nodes that waited at the server for room; `None` where the tissue was computed here.
    #[serde(default)]
    pub nodes_waiting_max: Option<u32>,
    /// The participant's number.
    pub participant: u16,
    /// Ticks of the force loop.
    pub ticks: u64,
    /// Ticks per second.
    pub rate_hz: f64,
    /// How late ticks began.
    pub lateness_us: Lateness,
    /// Deadlines of the force loop that were skipped.
    pub missed: u64,
    /// Round trip time, the newest; `None` when it was never measured.
    pub rtt_ms: Option<f64>,
    /// Share of the server's datagrams that did not arrive, 0 to 1.
    pub loss: f64,
    /// The artificial delay D at the end.
    pub compensation_ms: f64,
    /// Version of one's own topology.
    pub topology_version: u32,
    /// Hash of one's own topology, 16 hexadecimal digits.
    pub topology_hash: String,
    /// Operations applied, those of the log at the beginning included.
    pub operations: u64,
    /// Cuts among them.
    pub cuts: u64,
    /// How far the estimate of the server's clock can be wrong.
    pub clock_error_bound_ms: Option<f64>,
    /// Solves of the shape that the hand feels.
    pub haptic_solves: u64,
    /// How long they took.
    pub haptic_solve_ms: SolveTimes,
    /// Solves of the shape that everybody sees.
    pub view_solves: u64,
    /// How long they took.
    pub view_ms: SolveTimes,
    /// Moments of the common grid that were skipped because the machine was behind.
    pub views_skipped: u64,
    /// Nodes that the server said were elsewhere by more than a twentieth of a millimetre.
    pub corrected_nodes: u64,
    /// Farthest that a node was from where the server had it.
    pub drift_mm_max: f64,
    /// The largest force.
    pub force_max_n: f64,
    /// Smallest distance in mm between the tool and the tissue at rest, for a tool that touched nothing; below zero where
    /// the tool stayed inside the tissue.
    #[serde(default)]
    pub nearest_mm: Option<f64>,
    /// What the force loop met.
    pub events: EventCounts,
    /// Cuts that the server refused.
    pub cuts_refused: u64,
    /// What the device calls itself; "none" for who only looks.
    pub device: String,
    /// How the force loop was scheduled, in a sentence.
    pub realtime: String,
    /// Mean use of the processor over the session, by thread class.
    #[serde(default)]
    pub cpu: CpuUsage,
    /// How often the connection was lost and made anew.
    pub reconnects: u64,
    /// How often the copy of the tissue was made anew from the server's log, because it differed.
    #[serde(default)]
    pub resyncs: u64,
    /// How often the tool was lifted because the network needed more delay than the session allows.
    #[serde(default)]
    pub demotions: u64,
    /// Requests that were lost with a connection; each was said.
    #[serde(default)]
    pub requests_lost: u64,
    /// Length of the run, from the first view on.
    pub seconds: f64,
    /// How it ended, in a sentence.
    pub ended: String,
}

/// Percentiles of how late ticks began, µs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lateness {
    /// Half were earlier.
    pub p50: u64,
    /// 99 of 100 were earlier.
    pub p99: u64,
    /// 999 of 1000 were earlier.
    pub p999: u64,
    /// The latest.
    pub max: u64,
}

impl From<Percentiles> for Lateness {
    fn from(p: Percentiles) -> Self {
        Self {
            p50: p.p50,
            p99: p.p99,
            p999: p.p999,
            max: p.max,
        }
    }
}

/// Percentiles of how long solves took, ms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct SolveTimes {
    /// Half were shorter.
    pub p50: f64,
    /// 99 of 100 were shorter.
    pub p99: f64,
}

/// Ticks in which something happened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct EventCounts {
    /// In contact.
    pub in_contact: u64,
    /// Clamped to what the device can hold.
    pub saturated: u64,
    /// The change of force was limited.
    pub slewed: u64,
    /// Force was taken away, as the hand would have got more work back than it has put in.
    #[serde(default)]
    pub passivated: u64,
    /// The contact model was old.
    pub stale: u64,
    /// The tool was outside the contact model's radius.
    pub left_radius: u64,
    /// The sample was no number.
    pub bad_samples: u64,
    /// The contact model was not usable.
    pub bad_models: u64,
    /// The device was at fault.
    pub faulted: u64,
    /// The link was lost.
    pub link_lost: u64,
    /// Largest change of force between two ticks, N.
    pub max_delta_force_n: f64,
    /// Clamped to the torque that the device can hold.
    #[serde(default)]
    pub torque_saturated: u64,
    /// The change of torque was limited.
    #[serde(default)]
    pub torque_slewed: u64,
    /// Largest torque, N·m; zero on a device that renders none.
    #[serde(default)]
    pub torque_max_nm: f64,
    /// Largest change of torque between two ticks, N·m.
    #[serde(default)]
    pub max_delta_torque_nm: f64,
    /// Smallest energy the hand had put in, J.
    pub min_energy_j: f64,
    /// Wrenches that the device refused.
    #[serde(default)]
    pub device_rejected: u64,
    /// Times that the device took its force away by itself.
    #[serde(default)]
    pub device_cuts: u64,
    /// Samples that found no room on their way to the network.
    pub frames_dropped: u64,
}

impl EventCounts {
    fn of(c: &Counters, device: DeviceCounts, frames_dropped: u64) -> Self {
        Self {
            in_contact: c.in_contact,
            saturated: c.saturated,
            slewed: c.slewed,
            passivated: c.passivated,
            stale: c.stale,
            left_radius: c.left_radius,
            bad_samples: c.bad_samples,
            bad_models: c.bad_models,
            faulted: c.faulted,
            link_lost: c.link_lost,
            max_delta_force_n: c.max_delta_force_n,
            torque_saturated: c.torque_saturated,
            torque_slewed: c.torque_slewed,
            torque_max_nm: c.max_torque_nm,
            max_delta_torque_nm: c.max_delta_torque_nm,
            min_energy_j: c.min_energy_j,
            device_rejected: device.rejected,
            device_cuts: device.cuts,
            frames_dropped,
        }
    }
}

impl Summary {
    /// Takes over what the force loop says of itself.
    pub(crate) fn take_loop(&mut self, stats: &LoopStats) {
        self.ticks = stats.ticks;
        self.rate_hz = stats.rate_hz;
        self.lateness_us = stats.lateness_us.into();
        self.missed = stats.missed;
        self.force_max_n = stats.counters.max_force_n;
        self.events = EventCounts::of(&stats.counters, stats.device, stats.frames_dropped);
    }
}

/// The sentence for a tool that touched nothing.
fn untouched(nearest_mm: f64) -> String {
    if nearest_mm < 0.0 {
        format!(
            "the tool touched nothing: it stayed inside the tissue, at least {:.1} mm beneath the surface; begin outside, \
             because a tool is felt from outside",
            -nearest_mm
        )
    } else {
        format!(
            "the tool touched nothing: its smallest distance to the tissue surface was {nearest_mm:.1} mm; move the way \
             points into the tissue (`palpate-server inspect` prints where it is)"
        )
    }
}

impl fmt::Display for Summary {
    /// What a person wants to know at the end, one thing per line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |v: Option<f64>| v.map_or("unknown".to_owned(), |v| format!("{v:.1} ms"));
        writeln!(
            f,
            "{} ({}), {:.1} s: {}",
            self.name, self.role, self.seconds, self.ended
        )?;
        if self.ticks > 0 {
            let l = &self.lateness_us;
            writeln!(
                f,
                "  force loop   {:.0} Hz, late by {} µs (p50), {} (p99), {} (p99.9), {} (max); {} missed",
                self.rate_hz, l.p50, l.p99, l.p999, l.max, self.missed
            )?;
            writeln!(
                f,
                "  force        at most {:.2} N, changing at most {:.3} N per tick; {} ticks saturated, {} slewed, {} \
                 passivated, {} stale, {} faulted",
                self.force_max_n,
                self.events.max_delta_force_n,
                self.events.saturated,
                self.events.slewed,
                self.events.passivated,
                self.events.stale,
                self.events.faulted
            )?;
            if let Some(mm) = self.nearest_mm {
                writeln!(f, "  touch        {}", untouched(mm))?;
            }
            if self.events.torque_max_nm > 0.0 {
                writeln!(
                    f,
                    "  torque       at most {:.3} N·m, changing at most {:.4} N·m per tick; {} ticks saturated, {} slewed",
                    self.events.torque_max_nm,
                    self.events.max_delta_torque_nm,
                    self.events.torque_saturated,
                    self.events.torque_slewed
                )?;
            }
            writeln!(f, "  device       {}; {}", self.device, self.realtime)?;
        }
        writeln!(
            f,
            "  network      round trip {}, {:.1} % lost, delay D {:.1} ms, clock within {}",
            ms(self.rtt_ms),
            self.loss * 100.0,
            self.compensation_ms,
            ms(self.clock_error_bound_ms)
        )?;
        let waiting = self
            .nodes_waiting_max
            .map_or(String::new(), |n| format!(", at most {n} nodes waited"));
        writeln!(
            f,
            "  subscribed   {}, {:.0} kbit/s from the server{waiting}",
            self.subscription, self.down_kbit_s
        )?;
        writeln!(
            f,
            "  tissue       version {} ({}), {} operations, {} cuts, {} refused",
            self.topology_version,
            self.topology_hash,
            self.operations,
            self.cuts,
            self.cuts_refused
        )?;
        write!(
            f,
            "  solves       hand {} ({:.2} / {:.2} ms), view {} ({:.2} / {:.2} ms, {} skipped), at most {:.3} mm from the server's",
            self.haptic_solves,
            self.haptic_solve_ms.p50,
            self.haptic_solve_ms.p99,
            self.view_solves,
            self.view_ms.p50,
            self.view_ms.p99,
            self.views_skipped,
            self.drift_mm_max
        )?;
        write!(f, "\n  processor    {}", self.cpu)
    }
}
