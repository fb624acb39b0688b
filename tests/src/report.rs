//! What an experiment gives in the end: one JSON object, and the same for people.

use std::fmt;

use palpate_client::{Lateness, Summary};
use palpate_server::host::{HostSummary, TickTimes};
use serde::{Deserialize, Serialize};

use crate::disagreement::{CoursePoint, Disagreement, DistancesMm};
use crate::force_error::ForceError;
use crate::relay::{RelayStats, WayStats};

/// The figures of a demo.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Report {
    /// Nodes of the model.
    pub nodes: usize,
    /// Length of the scripts, s.
    pub seconds: f64,
    /// Who took part and left figures.
    pub participants: Vec<ParticipantReport>,
    /// The server.
    pub server: ServerReport,
    /// How far apart participants see the same item at the same instant of real time.
    pub view_disagreement_mm: DistancesMm,
    /// Of that, tools alone.
    pub tool_disagreement_mm: DistancesMm,
    /// Of that, nodes of the tissue alone.
    pub node_disagreement_mm: DistancesMm,
    /// How far apart participants show the same item for the same moment of the session.
    pub content_disagreement_mm: DistancesMm,
    /// The network between them.
    pub network: NetworkReport,
    /// What was cut.
    pub cut: CutReport,
    /// The run without a network; `None` when it failed.
    pub reference: Option<ReferenceReport>,
    /// What is wrong, one sentence each.
    pub problems: Vec<String>,
    /// What a reader should know, one sentence each.
    pub notes: Vec<String>,
    /// Whether all hashes are equal, nobody died, the cut arrived everywhere and every hand touched the tissue.
    pub ok: bool,
}

/// A participant's figures.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ParticipantReport {
    /// The name.
    pub name: String,
    /// The role.
    pub role: String,
    /// Ticks of the force loop; 0 for who only looks.
    pub ticks: u64,
    /// Ticks per second.
    pub rate_hz: f64,
    /// How late ticks began, µs.
    pub lateness_us: Lateness,
    /// Deadlines that were skipped.
    pub missed: u64,
    /// Round trip time, as the client measured it.
    pub rtt_ms: Option<f64>,
    /// Share of the server's datagrams that did not arrive, 0 to 1, as the client measured it.
    pub loss: f64,
    /// The artificial delay D in the end.
    pub compensation_ms: f64,
    /// Hash of its topology in the end.
    pub topology_hash: String,
    /// Version of its topology in the end.
    pub topology_version: u32,
    /// Error of the contact force against the run without a network, percent rms; `None` for who
    /// only looks.
    pub force_error_rms: Option<f64>,
    /// The same in more detail.
    pub force_error: Option<ForceError>,
    /// All figures that the client gave.
    pub summary: Summary,
}

/// The server's figures.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ServerReport {
    /// Ticks done.
    pub ticks: u64,
    /// How long they took.
    pub tick_ms: TickTimes,
    /// Time between two.
    pub tick_period_ms: f64,
    /// Operations in the log.
    pub operations: usize,
    /// Hash of its topology in the end.
    pub topology_hash: String,
    /// Version of its topology in the end.
    pub topology_version: u32,
}

/// The network: what the relay was told to do and what it did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct NetworkReport {
    /// The profile's name.
    pub profile: String,
    /// The seed.
    pub seed: u64,
    /// Packets that came to the relay, both directions.
    pub sent: u64,
    /// Packets that it lost on purpose.
    pub dropped: u64,
    /// Packets that it let overtake others.
    pub reordered: u64,
    /// What became of packets to the server.
    #[serde(default)]
    pub up: WayStats,
    /// What became of packets to clients.
    #[serde(default)]
    pub down: WayStats,
    /// Share of packets it lost, 0 to 1.
    pub loss: f64,
    /// Mean delay it gave, one way, ms.
    pub delay_mean_ms: f64,
    /// 99th percentile of that delay, ms.
    pub delay_p99_ms: f64,
    /// How late it was itself, 99th percentile, ms.
    pub lateness_p99_ms: f64,
}

/// What was cut.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CutReport {
    /// Cuts in the log.
    pub operations: u64,
    /// Connected pieces of the tissue.
    pub components: usize,
    /// Whether the outer surface is closed, wounds included.
    pub boundary_closed: bool,
    /// When each participant had applied the first cut, ms after the first of them had.
    pub applied_after_ms: Vec<(String, f64)>,
}

/// The run without a network.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ReferenceReport {
    /// How long computing it took, s.
    pub seconds: f64,
    /// Moments of its cuts, seconds of script.
    pub cuts_s: Vec<f64>,
}

impl From<RelayStats> for NetworkReport {
    fn from(s: RelayStats) -> Self {
        Self {
            profile: s.profile,
            seed: s.seed,
            sent: s.sent,
            dropped: s.dropped,
            reordered: s.reordered,
            up: s.up,
            down: s.down,
            loss: s.loss,
            delay_mean_ms: s.delay_mean_ms,
            delay_p99_ms: s.delay_p99_ms,
            lateness_p99_ms: s.lateness_p99_ms,
        }
    }
}

impl ServerReport {
    /// The server's part of its summary.
    pub fn of(s: &HostSummary) -> Self {
        Self {
            ticks: s.ticks,
            tick_ms: s.tick_ms,
            tick_period_ms: s.tick_period_ms,
            operations: s.operations,
            topology_hash: s.topology_hash.clone(),
            topology_version: s.topology_version,
        }
    }
}

impl ParticipantReport {
    /// A participant's figures, with the error of its force where there is one.
    pub fn of(summary: Summary, force_error: Option<ForceError>) -> Self {
        let s = summary.clone();
        Self {
            name: s.name,
            role: s.role,
            ticks: s.ticks,
            rate_hz: s.rate_hz,
            lateness_us: s.lateness_us,
            missed: s.missed,
            rtt_ms: s.rtt_ms,
            loss: s.loss,
            compensation_ms: s.compensation_ms,
            topology_hash: s.topology_hash,
            topology_version: s.topology_version,
            force_error_rms: force_error.map(|e| e.rms_percent),
            force_error,
            summary,
        }
    }
}

impl Report {
    /// Looks for what must not be: hashes that differ, a cut that did not arrive, a hand that touched nothing.
    pub fn judge(&mut self) {
        let server = &self.server;
        if self.cut.operations == 0 || server.topology_version == 0 {
            self.problems
                .push("the cut did not arrive: the server made none".to_owned());
        }
        for p in &self.participants {
            if p.topology_hash != server.topology_hash {
                self.problems.push(format!(
                    "{} has topology {} (version {}), the server {} (version {})",
                    p.name,
                    p.topology_hash,
                    p.topology_version,
                    server.topology_hash,
                    server.topology_version
                ));
            }
        }
        // Forces of air are right whatever the network does: without a contact nothing has been shown.
        for p in self.participants.iter().filter(|p| p.ticks > 0) {
            if p.summary.force_max_n == 0.0 {
                self.problems.push(format!(
                    "{} touched nothing: the largest force is 0 N; choose a model with more room around the middle of \
                     its surface",
                    p.name
                ));
            }
        }
        self.ok = self.problems.is_empty();
    }

    /// Takes the figures of views.
    pub fn take_disagreement(&mut self, d: &Disagreement) -> Vec<CoursePoint> {
        self.view_disagreement_mm = d.views;
        self.tool_disagreement_mm = d.tools;
        self.node_disagreement_mm = d.nodes;
        self.content_disagreement_mm = d.contents;
        d.course.clone()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let n = &self.network;
        writeln!(
            f,
            "Session of {:.0} s over a model of {} nodes, network {} (seed {})\n",
            self.seconds, self.nodes, n.profile, n.seed
        )?;
        self.write_participants(f)?;
        let s = &self.server;
        writeln!(
            f,
            "\nserver         {} ticks of {:.2} ms (p50), {:.2} ms (p99), {:.2} ms (max); period {:.1} ms; {} operations",
            s.ticks, s.tick_ms.p50, s.tick_ms.p99, s.tick_ms.max, s.tick_period_ms, s.operations
        )?;
        self.write_network(f)?;
        writeln!(
            f,
            "\ndisagreement in mm           p50      p95      max    compared"
        )?;
        for (name, d) in [
            ("views, same instant", &self.view_disagreement_mm),
            ("  of tools", &self.tool_disagreement_mm),
            ("  of tissue nodes", &self.node_disagreement_mm),
            ("contents, same moment s", &self.content_disagreement_mm),
        ] {
            writeln!(
                f,
                "{name:<24} {:>8.3} {:>8.3} {:>8.3} {:>11}",
                d.p50, d.p95, d.max, d.count
            )?;
        }
        let c = &self.cut;
        writeln!(
            f,
            "\ncut            {} operation(s), {} piece(s), outer surface {}",
            c.operations,
            c.components,
            if c.boundary_closed { "closed" } else { "OPEN" }
        )?;
        if let Some(r) = &self.reference {
            writeln!(
                f,
                "reference      without a network, computed in {:.1} s",
                r.seconds
            )?;
        }
        writeln!(f, "topology       server {}", s.topology_hash)?;
        for p in &self.participants {
            let verdict = if p.topology_hash == s.topology_hash {
                "equal"
            } else {
                "DIFFERENT"
            };
            writeln!(f, "               {} {} {verdict}", p.name, p.topology_hash)?;
        }
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        for problem in &self.problems {
            writeln!(f, "PROBLEM: {problem}")?;
        }
        write!(f, "\n{}", if self.ok { "ok" } else { "NOT ok" })
    }
}

impl Report {
    fn write_participants(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "participant    role        loop Hz  late µs p50/p99/p99.9/max   missed  RTT ms  loss %   D ms  force error %"
        )?;
        for p in &self.participants {
            let l = &p.lateness_us;
            let (rate, late) = if p.ticks > 0 {
                (
                    format!("{:.0}", p.rate_hz),
                    format!("{}/{}/{}/{}", l.p50, l.p99, l.p999, l.max),
                )
            } else {
                ("-".to_owned(), "-".to_owned())
            };
            let or_dash = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.1}"));
            writeln!(
                f,
                "{:<14} {:<11} {rate:>7}  {late:<26} {:>7} {:>7} {:>7.1} {:>6.1} {:>14}",
                p.name,
                p.role,
                p.missed,
                or_dash(p.rtt_ms),
                p.loss * 100.0,
                p.compensation_ms,
                or_dash(p.force_error_rms)
            )?;
        }
        Ok(())
    }

    fn write_network(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let n = &self.network;
        writeln!(
            f,
            "injected       delay {:.1} ms one way (p99 {:.1}), loss {:.2} % ({} of {}), {} overtook; relay late by {:.1} ms (p99)",
            n.delay_mean_ms,
            n.delay_p99_ms,
            n.loss * 100.0,
            n.dropped,
            n.sent,
            n.reordered,
            n.lateness_p99_ms
        )?;
        writeln!(f, "  to server    {}", n.up)?;
        writeln!(f, "  to clients   {}", n.down)?;
        let rtts: Vec<f64> = self.participants.iter().filter_map(|p| p.rtt_ms).collect();
        let losses: Vec<f64> = self.participants.iter().map(|p| p.loss).collect();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        writeln!(
            f,
            "measured       round trip {:.1} ms (injected {:.1}), loss of what the server sent {:.2} %",
            mean(&rtts),
            2.0 * n.delay_mean_ms,
            mean(&losses) * 100.0
        )
    }
}

/// What the figures of a report mean, for people.
pub const DEFINITIONS: &str = "\
disagreement of views     at the same instant of real time (a grid of 10 ms, views interpolated
                          linearly): distance between where two participants see the same tool or
                          the same node; all pairs; an item counts while it moves or is displaced
                          by more than 0.05 mm at either side
disagreement of contents  the same for the same moment s of the session, whenever it is shown
force error               rms of |F - F_ref| over rms of |F_ref| in contact, aligned on the time of
                          the script; F_ref is felt by the same hands with the same scripts at one
                          table, without a network
measured round trip       by the client's clock probes; it includes the time in both programs";
