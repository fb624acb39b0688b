//! Summary of a run, as text and as one JSON object.

use std::fmt;

use palpate_haptics::Counters;
use palpate_transport::threads::CpuUsage;
use serde::{Deserialize, Serialize};

use crate::realtime::{DeviceCounts, Lateness, LoopStats};

/// Summary of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The participant's name.
    pub name: String,
    /// Word of the role.
    pub role: String,
    /// The word for what of the tissue was sent: full or thin.
    #[serde(default)]
    pub subscription: String,
    /// Data received over the last connection, without the model, kbit/s of UDP payload.
    #[serde(default)]
    pub down_kbit_s: f64,
    /// Maximum number of nodes queued at the server; `None` for a full subscription.
    #[serde(default)]
    pub nodes_waiting_max: Option<u32>,
    /// The participant's number.
    pub participant: u16,
    /// Ticks of the force loop.
    pub ticks: u64,
    /// Ticks per second.
    pub rate_hz: f64,
    /// Lateness of ticks.
    pub lateness_us: Lateness,
    /// Skipped deadlines of the force loop.
    pub missed: u64,
    /// Latest round-trip time; `None` if it was never measured.
    pub rtt_ms: Option<f64>,
    /// Loss of the server's datagrams, 0 to 1.
    pub loss: f64,
    /// The artificial delay D at the end.
    pub compensation_ms: f64,
    /// Version of the client's topology.
    pub topology_version: u32,
    /// Hash of the client's topology, 16 hexadecimal digits.
    pub topology_hash: String,
    /// Applied operations, including the initial log.
    pub operations: u64,
    /// Cuts among them.
    pub cuts: u64,
    /// Error bound of the clock offset.
    pub clock_error_bound_ms: Option<f64>,
    /// Solves of the haptic shape.
    pub haptic_solves: u64,
    /// Their duration.
    pub haptic_solve_ms: SolveTimes,
    /// Solves of the view shape.
    pub view_solves: u64,
    /// Their duration.
    pub view_ms: SolveTimes,
    /// Skipped points of the common grid.
    pub views_skipped: u64,
    /// Nodes corrected because they differed from the server's by more than 0.05 mm.
    pub corrected_nodes: u64,
    /// Largest distance between a node and its position at the server.
    pub drift_mm_max: f64,
    /// Largest force, N.
    pub force_max_n: f64,
    /// Smallest distance in mm between the tool and the tissue at rest, for a tool that touched nothing; negative if
    /// the tool stayed inside the tissue.
    #[serde(default)]
    pub nearest_mm: Option<f64>,
    /// Events of the force loop.
    pub events: EventCounts,
    /// Cut requests rejected by the server.
    pub cuts_refused: u64,
    /// Name reported by the device; "none" for spectators.
    pub device: String,
    /// Scheduling of the force loop.
    pub realtime: String,
    /// Mean processor use in the session, by thread class.
    #[serde(default)]
    pub cpu: CpuUsage,
    /// Number of reconnects.
    pub reconnects: u64,
    /// Number of resyncs from the server's log.
    #[serde(default)]
    pub resyncs: u64,
    /// Number of demotions, because the network needed more delay than the session allows.
    #[serde(default)]
    pub demotions: u64,
    /// Requests lost with a connection; each was reported.
    #[serde(default)]
    pub requests_lost: u64,
    /// Duration from the first view.
    pub seconds: f64,
    /// How the session ended.
    pub ended: String,
}

/// Percentiles of solve times, ms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct SolveTimes {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
}

/// Number of ticks with each event.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct EventCounts {
    /// In contact.
    pub in_contact: u64,
    /// Force clamped to the device's limit.
    pub saturated: u64,
    /// Force change limited.
    pub slewed: u64,
    /// Force removed by the passivity controller, because the hand would have received more energy than it supplied.
    #[serde(default)]
    pub passivated: u64,
    /// The contact model was too old.
    pub stale: u64,
    /// The tool was outside the contact model's radius.
    pub left_radius: u64,
    /// The sample was NaN.
    pub bad_samples: u64,
    /// The contact model was not usable.
    pub bad_models: u64,
    /// Device fault.
    pub faulted: u64,
    /// The link was lost.
    pub link_lost: u64,
    /// Largest change of force between two ticks, N.
    pub max_delta_force_n: f64,
    /// Torque clamped to the device's limit.
    #[serde(default)]
    pub torque_saturated: u64,
    /// Torque change limited.
    #[serde(default)]
    pub torque_slewed: u64,
    /// Largest torque, N·m; zero on a device that renders none.
    #[serde(default)]
    pub torque_max_nm: f64,
    /// Largest change of torque between two ticks, N·m.
    #[serde(default)]
    pub max_delta_torque_nm: f64,
    /// Minimum of the passivity observer: net energy supplied by the hand, J.
    pub min_energy_j: f64,
    /// Wrenches rejected by the device.
    #[serde(default)]
    pub device_rejected: u64,
    /// Times that the device dropped its force.
    #[serde(default)]
    pub device_cuts: u64,
    /// Samples dropped on their way to the network.
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
    /// Adds the statistics of the force loop.
    pub(crate) fn take_loop(&mut self, stats: &LoopStats) {
        self.ticks = stats.ticks;
        self.rate_hz = stats.rate_hz;
        self.lateness_us = stats.lateness_us;
        self.missed = stats.missed;
        self.force_max_n = stats.counters.max_force_n;
        self.events = EventCounts::of(&stats.counters, stats.device, stats.frames_dropped);
    }
}

/// Message for a tool that touched nothing.
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
    /// Text summary, one topic per line.
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
