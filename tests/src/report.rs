//! The report of a demo: one JSON object, and its text form.

use std::fmt;

use palpate_client::Summary;
use palpate_client::recording::Recording;
use palpate_server::host::HostSummary;
use serde::{Deserialize, Serialize};

use crate::bench::quantile;
use crate::cpu::{CpuRow, CpuTable};
use crate::criteria::{self, Criterion, Expected};
use crate::delay_figures::DelayFigures;
use crate::disagreement::{Disagreement, DistancesMm};
use crate::dropout::Dropouts;
use crate::force_error::ForceError;
use crate::insertions::Insertions;
use crate::reference::{Quality, Reference};
use crate::relay::RelayStats;

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Report {
    pub nodes: usize,
    pub seconds: f64,
    pub stress: u16,
    pub participants: Vec<ParticipantReport>,
    pub server: HostSummary,
    /// How far apart participants see the same item at the same instant of real time.
    pub view_disagreement_mm: DistancesMm,
    pub tool_disagreement_mm: DistancesMm,
    pub node_disagreement_mm: DistancesMm,
    /// How far apart participants show the same item for the same moment of the session.
    pub content_disagreement_mm: DistancesMm,
    pub network: RelayStats,
    pub cut: CutReport,
    /// Insertions of the holder's needle, as each participant shows them; empty without a needle.
    pub insertions: Vec<Insertions>,
    /// The playout delay D over the scripts; `None` when no view was recorded.
    pub delay: Option<DelayFigures>,
    pub cpu: Vec<CpuRow>,
    /// The run without a network; `None` if it failed.
    pub reference: Option<ReferenceReport>,
    /// Processes that died, one sentence each.
    pub problems: Vec<String>,
    /// Notes for the reader, one sentence each.
    pub notes: Vec<String>,
    pub criteria: Vec<Criterion>,
    pub ok: bool,
}

/// The summary of a participant's client, and the figures of its recording.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct ParticipantReport {
    #[serde(flatten)]
    pub summary: Summary,
    /// Error of the contact force against the run without a network, percent rms; `None` for a spectator.
    pub force_error_rms: Option<f64>,
    pub force_error: Option<ForceError>,
    /// Dropouts of the force; `None` without a reference or a script.
    pub dropouts: Option<Dropouts>,
    /// Longest time of the script without a recorded force, ms; `None` without a script.
    pub recording_gap_ms: Option<f64>,
    /// Points, views and operations dropped from a full recording.
    pub records_dropped: u64,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct CutReport {
    pub strokes: u64,
    pub operations: u64,
    pub components: usize,
    /// Whether the outer surface is closed, wounds included.
    pub boundary_closed: bool,
    pub late_ms: Vec<CutLateness>,
}

/// Time from the moment when a site shows the blade at the end of a part of a stroke until it shows the part cut, ms.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CutLateness {
    pub participant: String,
    /// Parts that the participant saw cut.
    pub parts: usize,
    pub p50_ms: f64,
    pub p95_ms: f64,
    pub max_ms: f64,
}

impl CutLateness {
    pub fn of(recording: &Recording) -> Self {
        // A newcomer receives the parts before its first view with the model.
        let from = recording.views.first().map_or(i64::MAX, |view| view.s_us);
        let cuts = recording.operations.iter().filter(|o| o.stroke.is_some());
        let late: Vec<f64> = cuts
            .filter(|o| o.at_us >= from)
            .filter_map(|o| Some(o.late_us? as f64 * 1e-3))
            .collect();
        let at = |share| {
            if late.is_empty() {
                0.0
            } else {
                quantile(&late, share)
            }
        };
        Self {
            participant: recording.name.clone(),
            parts: late.len(),
            p50_ms: at(0.5),
            p95_ms: at(0.95),
            max_ms: at(1.0),
        }
    }
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct ReferenceReport {
    pub seconds: f64,
    /// Times of its cuts, seconds of script.
    pub cuts_s: Vec<f64>,
    /// Largest distance between the cuts of the session, which the reference uses, and those of its own hands,
    /// mm.
    pub cut_apart_mm: f64,
    #[serde(flatten)]
    pub quality: Quality,
}

impl ReferenceReport {
    pub fn of(reference: &Reference, seconds: f64) -> Self {
        Self {
            seconds,
            cuts_s: reference.cuts_s.clone(),
            cut_apart_mm: reference.cut_apart_m * 1e3,
            quality: reference.quality,
        }
    }
}

impl ParticipantReport {
    /// The figures of a client summary and its force error; those of its recording stay empty.
    pub fn of(summary: Summary, force_error: Option<ForceError>) -> Self {
        Self {
            summary,
            force_error_rms: force_error.map(|e| e.rms_percent),
            force_error,
            ..Self::default()
        }
    }
}

impl Report {
    pub fn judge(&mut self, expected: &Expected<'_>) {
        self.cut.strokes = expected.strokes;
        self.criteria = criteria::judge(self, expected);
        self.ok = self.criteria.iter().all(|c| c.ok);
    }

    pub fn set_disagreement(&mut self, d: &Disagreement) {
        self.view_disagreement_mm = d.views;
        self.tool_disagreement_mm = d.tools;
        self.node_disagreement_mm = d.nodes;
        self.content_disagreement_mm = d.contents;
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n\nDetails\n", self.summary())?;
        self.write_participants(f)?;
        let s = &self.server;
        writeln!(
            f,
            "\nserver         {} ticks of {:.2} ms (p50), {:.2} ms (p99), {:.2} ms (max); period {:.1} ms; {} operations",
            s.ticks, s.tick_ms.p50, s.tick_ms.p99, s.tick_ms.max, s.tick_period_ms, s.operations
        )?;
        self.write_network(f)?;
        writeln!(f, "\n{}", CpuTable(&self.cpu))?;
        self.write_disagreement(f)?;
        self.write_topologies(f)?;
        writeln!(f, "\n{} criteria", self.criteria.len())?;
        // Failed criteria are in the summary.
        for criterion in self.criteria.iter().filter(|c| c.ok) {
            let line = criterion.to_string();
            writeln!(f, "  {}", line.trim_start_matches("passed: "))?;
        }
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        Ok(())
    }
}

/// The first lines of a report: result and main figures.
pub struct Brief<'a>(&'a Report);

impl Report {
    /// The result in ten lines, and a line for each failed criterion.
    pub fn summary(&self) -> Brief<'_> {
        Brief(self)
    }

    fn write_disagreement(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
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
        Ok(())
    }

    fn write_topologies(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = &self.cut;
        writeln!(
            f,
            "\ncut            {} operation(s), {} piece(s), outer surface {}",
            c.operations,
            c.components,
            if c.boundary_closed { "closed" } else { "OPEN" }
        )?;
        if let Some(r) = &self.reference {
            let q = &r.quality;
            writeln!(
                f,
                "reference      {:.1} s for {} solves; {} checks to a residual of {:.3} changed forces by {:.1} and {:.1} %; \
                 its own cut would be {:.2} mm away",
                r.seconds,
                q.solves,
                q.checks,
                q.residual_max,
                q.error_percent[0],
                q.error_percent[1],
                r.cut_apart_mm
            )?;
        }
        let s = &self.server;
        writeln!(f, "topology       server {}", s.topology_hash)?;
        for p in &self.participants {
            let p = &p.summary;
            let verdict = if p.topology_hash == s.topology_hash {
                "equal"
            } else {
                "DIFFERENT"
            };
            writeln!(f, "               {} {} {verdict}", p.name, p.topology_hash)?;
        }
        Ok(())
    }
}

impl fmt::Display for Brief<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let r = self.0;
        let n = &r.network;
        write!(
            f,
            "Session of {:.0} s on a model of {} nodes, network {} (seed {})",
            r.seconds, r.nodes, n.profile, n.seed
        )?;
        if r.stress > 0 {
            write!(f, ", beside {} busy process(es)", r.stress)?;
        }
        let failed = r.criteria.iter().filter(|c| !c.ok);
        let (bad, all) = (failed.clone().count(), r.criteria.len());
        if r.ok {
            writeln!(f, "\nok: all {all} criteria passed")?;
        } else {
            writeln!(f, "\nNOT ok: {bad} of {all} criteria failed")?;
        }
        for criterion in failed {
            writeln!(f, "{criterion}")?;
        }
        for problem in &r.problems {
            writeln!(f, "PROBLEM: {problem}")?;
        }
        writeln!(f)?;
        for p in r.participants.iter().filter(|p| p.summary.ticks > 0) {
            writeln!(f, "force of the {:<11} {}", p.summary.name, ForceOf(p))?;
        }
        if let Some(d) = &r.delay {
            let (median, max) = (d.median_ms, d.max_ms);
            writeln!(
                f,
                "playout delay D          {median:.0} ms (median), {max:.0} ms (largest); round trip {:.0} ms",
                2.0 * n.delay_mean_ms
            )?;
        }
        let has = |p: &&ParticipantReport| p.summary.cuts >= r.cut.strokes;
        writeln!(
            f,
            "cuts                     {} of {} at the server, at {} of {} participants",
            r.cut.operations,
            r.cut.strokes,
            r.participants.iter().filter(has).count(),
            r.participants.len()
        )?;
        writeln!(
            f,
            "views                    {:.2} mm apart at the same instant (95 %), {:.2} mm for the same moment",
            r.view_disagreement_mm.p95, r.content_disagreement_mm.p95
        )?;
        for late in r.cut.late_ms.iter().filter(|late| late.parts > 0) {
            writeln!(
                f,
                "cuts seen by {:<10} {} parts, behind the blade by {:.0} ms (median), {:.0} ms (95 %), {:.0} ms (largest)",
                late.participant, late.parts, late.p50_ms, late.p95_ms, late.max_ms
            )?;
        }
        for seen in &r.insertions {
            let apart = seen
                .apart_ms
                .map_or("unknown".to_owned(), |ms| format!("{ms:.0} ms"));
            writeln!(
                f,
                "needle seen by {:<9} {} insertions, at most {apart} apart from the holder at the same moment",
                seen.participant, seen.count
            )?;
        }
        let cores = r
            .cpu
            .iter()
            .map(|c| format!("{} {:.2}", c.process, c.cores));
        let cores: Vec<String> = cores.collect();
        writeln!(f, "mean CPU cores           {}", cores.join(", "))?;
        match &r.reference {
            Some(q) => {
                let error = q.quality.error_percent.into_iter().fold(0.0, f64::max);
                write!(
                    f,
                    "reference                the same hands without a network, computed in {:.1} s, error at most {error:.1} %",
                    q.seconds
                )
            }
            None => write!(f, "reference                missing"),
        }
    }
}

struct ForceOf<'a>(&'a ParticipantReport);

impl fmt::Display for ForceOf<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.force_error_rms {
            Some(percent) => write!(f, "{percent:.1} % from the reference, ")?,
            None => write!(f, "error unknown, ")?,
        }
        match &self.0.dropouts {
            None => write!(f, "dropouts unknown"),
            Some(d) if d.count == 0 => write!(f, "no dropout"),
            Some(d) => write!(
                f,
                "{} dropout(s): longest {:.0} ms, {:.0} ms of {:.1} s of contact",
                d.count, d.longest_ms, d.total_ms, d.contact_s
            ),
        }
    }
}

impl Report {
    fn write_participants(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "participant    role        loop Hz  late µs p50/p99/p99.9/max   missed  RTT ms  loss %   D ms  force error %"
        )?;
        for participant in &self.participants {
            let p = &participant.summary;
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
                or_dash(participant.force_error_rms)
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
            n.total.dropped,
            n.total.sent,
            n.total.reordered,
            n.lateness_p99_ms
        )?;
        writeln!(f, "  to server    {}", n.up)?;
        writeln!(f, "  to clients   {}", n.down)?;
        let rtts: Vec<f64> = self
            .participants
            .iter()
            .filter_map(|p| p.summary.rtt_ms)
            .collect();
        let losses: Vec<f64> = self.participants.iter().map(|p| p.summary.loss).collect();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        writeln!(
            f,
            "measured       round trip {:.1} ms (injected {:.1}), loss on the downlink {:.2} %",
            mean(&rtts),
            2.0 * n.delay_mean_ms,
            mean(&losses) * 100.0
        )
    }
}

pub const DEFINITIONS: &str = "\
disagreement of views     at the same instant of real time (a grid of 10 ms, views interpolated
                          linearly): distance between the positions of the same tool or node at
                          two participants; all pairs; an item counts while it moves or is displaced
                          by more than 0.05 mm on either side
disagreement of contents  the same for the same moment s of the session, whenever it is shown
force error               rms of |F - F_ref| over rms of |F_ref| in contact, aligned on the time of
                          the script; F_ref is the force on the same hands with the same
                          scripts, without a network
dropout                   more than 20 ms in which F_ref is in contact (above 0.05 N and above 20 % of
                          its largest value) and |F| is below 80 % of |F_ref|; F_ref is the smallest
                          within 8 ms to both sides
playout delay D           delay of views at which all participants see the same; over all views from
                          one second after the start of the scripts to their end
measured round trip       by the client's clock probes; it includes the time in both programs";

#[cfg(test)]
mod tests {
    use palpate_client::recording::ViewRecord;
    use palpate_protocol::ServerTime;
    use palpate_protocol::operation::CutStroke;
    use palpate_site::OperationRecord;

    use super::*;

    #[test]
    fn parts_before_the_first_view_of_a_newcomer_are_not_late() {
        let part = |at_us, late_us| OperationRecord {
            id: 0,
            kind: "cut".to_owned(),
            at_us,
            applied_us: 0,
            late_us: Some(late_us),
            version: 1,
            hash: String::new(),
            script_at_us: None,
            stroke: Some(CutStroke {
                began: ServerTime::ZERO,
                joins: false,
                points: Vec::new(),
                width_m: 0.0,
            }),
        };
        let mut recording = Recording {
            operations: vec![part(1000, 2_000_000), part(2000, 8000)],
            ..Recording::default()
        };
        assert_eq!(CutLateness::of(&recording).parts, 0);
        recording.views.push(ViewRecord {
            s_us: 1500,
            ..ViewRecord::default()
        });
        let late = CutLateness::of(&recording);
        assert_eq!((late.parts, late.max_ms), (1, 8.0));
    }
}
