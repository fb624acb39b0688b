//! The criteria of a demo: a table of figures and their limits.
//!
//! A missing figure fails its criterion.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::report::{ParticipantReport, Report};

pub const FORCE_ERROR_PERCENT: f64 = 10.0;

/// Maximum dropout, ms; without and with busy processes beside the session.
pub const DROPOUT_MS: [f64; 2] = [40.0, 60.0];

/// Minimum peak force, N: without contact every force is correct on any network.
pub const TOUCH_N: f64 = crate::dropout::CONTACT_MIN_N;

/// Maximum relative residual of a check of the reference.
pub const RESIDUAL: f64 = 0.03;

/// Maximum estimated error of the reference, percent: half of the limit of a session.
pub const REFERENCE_ERROR_PERCENT: f64 = 5.0;

/// Maximum distance of a cut from that of the reference, mm: half the finest lattice spacing in use.
pub const CUT_APART_MM: f64 = 2.0;

/// Maximum median time by which a trainee sees parts of strokes behind the blade, ms: a hand at 20 mm/s is then 5 mm
/// ahead of its wound.
pub const CUT_BEHIND_MS: f64 = 250.0;

/// Maximum time for which a site shows another state of a needle than its holder at the same session time, ms: twice the time
/// for which the motion of a tool is extrapolated.
pub const INSERTION_APART_MS: f64 = 100.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    AtMost,
    AtLeast,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Criterion {
    pub criterion: String,
    /// Its value; `None` if missing.
    pub value: Option<f64>,
    pub limit: f64,
    pub bound: Bound,
    /// The unit of both; empty for counts.
    pub unit: String,
    pub ok: bool,
}

impl Criterion {
    pub(crate) fn new(
        criterion: impl Into<String>,
        value: Option<f64>,
        bound: Bound,
        limit: f64,
        unit: &str,
    ) -> Self {
        let ok = value.is_some_and(|v| match bound {
            // A comparison with NaN is false.
            Bound::AtMost => v <= limit,
            Bound::AtLeast => v >= limit,
        });
        Self {
            criterion: criterion.into(),
            // JSON has no infinity and no NaN.
            value: value.filter(|v| v.is_finite()),
            limit,
            bound,
            unit: unit.to_owned(),
            ok,
        }
    }

    pub(crate) fn at_most(
        criterion: impl Into<String>,
        value: Option<f64>,
        limit: f64,
        unit: &str,
    ) -> Self {
        Self::new(criterion, value, Bound::AtMost, limit, unit)
    }

    /// A count that must be zero.
    pub(crate) fn none_of(criterion: impl Into<String>, count: Option<u64>) -> Self {
        Self::at_most(criterion, count.map(|n| n as f64), 0.0, "")
    }
}

impl fmt::Display for Criterion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = match self.unit.as_str() {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        let verdict = if self.ok { "passed" } else { "FAILED" };
        write!(f, "{verdict}: {}, ", self.criterion)?;
        match self.value {
            Some(value) => write!(f, "{}{unit}", Short(value))?,
            None => write!(f, "missing")?,
        }
        let side = match self.bound {
            Bound::AtMost => "at most",
            Bound::AtLeast => "at least",
        };
        write!(f, ", limit {side} {}{unit}", Short(self.limit))
    }
}

struct Short(f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = match self.0.abs() {
            v if v.fract() == 0.0 => 0,
            v if v >= 1.0 => 1,
            _ => 3,
        };
        write!(f, "{:.digits$}", self.0)
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Expected<'a> {
    pub trainees: &'a [&'a str],
    pub others: &'a [&'a str],
    /// Strokes of the blade in the scripts; each one is a cut.
    pub strokes: u64,
    /// Insertions of the needle in the script of the first trainee.
    pub insertions: u64,
    /// Maximum D, ms; `None` if D is not judged.
    pub delay_limit_ms: Option<f64>,
    /// Whether the maximum delay covers the network, so that no participant may be demoted.
    pub is_covered: bool,
}

pub fn judge(report: &Report, expected: &Expected<'_>) -> Vec<Criterion> {
    let mut judged = Judged::default();
    for name in expected.trainees {
        judged.hand(report, name);
    }
    judged.shared(report, expected);
    if expected.insertions > 0 {
        judged.insertions(report, expected);
    }
    judged.complete(report, expected);
    judged.0
}

/// The criteria judged so far.
#[derive(Default)]
struct Judged(Vec<Criterion>);

impl Judged {
    fn at_most(&mut self, what: impl Into<String>, value: Option<f64>, limit: f64, unit: &str) {
        let criterion = Criterion::new(what, value, Bound::AtMost, limit, unit);
        self.0.push(criterion);
    }

    /// A count that must be zero.
    fn none_of(&mut self, what: &str, count: Option<u64>) {
        self.at_most(what, count.map(|n| n as f64), 0.0, "");
    }

    fn hand(&mut self, report: &Report, name: &str) {
        let limit_ms = DROPOUT_MS[usize::from(report.stress > 0)];
        let p = find(report, name);
        let error = p.and_then(|p| p.force_error_rms);
        let dropout = p.and_then(|p| p.dropouts.as_ref()).map(|d| d.longest_ms);
        let force = p.map(|p| p.summary.force_max_n);
        let gap = p.and_then(|p| p.recording_gap_ms);
        let of = |what: &str| format!("{what} {name}");
        self.at_most(of("force error of the"), error, FORCE_ERROR_PERCENT, "%");
        self.at_most(of("longest dropout of the"), dropout, limit_ms, "ms");
        let touches = of("largest force on the");
        let touches = Criterion::new(touches, force, Bound::AtLeast, TOUCH_N, "N");
        self.0.push(touches);
        let recorded = of("longest gap in the recorded force of the");
        self.at_most(recorded, gap, limit_ms, "ms");
    }

    fn shared(&mut self, report: &Report, expected: &Expected<'_>) {
        let participants = &report.participants;
        if let Some(limit_ms) = expected.delay_limit_ms {
            let largest = report.delay.map(|d| d.max_ms);
            self.at_most("largest playout delay D", largest, limit_ms, "ms");
        }
        if expected.is_covered {
            let demoted = participants.iter().map(|p| p.summary.demotions).sum();
            let demotions = report.server.demotions.max(demoted);
            self.none_of("demotions to spectator", Some(demotions));
        }
        let arrived = participants.iter().map(|p| p.summary.cuts).min();
        let arrived = arrived.map(|n| n.min(report.cut.operations));
        let lost = arrived.map(|n| expected.strokes.saturating_sub(n));
        self.none_of("lost cuts", lost);
        for name in expected.trainees {
            let late = report.cut.late_ms.iter().find(|l| l.participant == *name);
            let median = late.filter(|l| l.parts > 0).map(|l| l.p50_ms);
            let what = format!("cuts behind the blade, seen by the {name}");
            self.at_most(what, median, CUT_BEHIND_MS, "ms");
        }
        let server = &report.server.topology_hash;
        let hashes = participants.iter().map(|p| &p.summary.topology_hash);
        let differ = hashes.filter(|hash| *hash != server).count() as u64;
        let differ = (!participants.is_empty()).then_some(differ);
        self.none_of("topologies that differ from the server's", differ);
        let open = u64::from(!report.cut.boundary_closed);
        self.none_of("open outer surfaces", Some(open));
    }

    /// The needle of the first trainee.
    fn insertions(&mut self, report: &Report, expected: &Expected<'_>) {
        let of = |name: &str| report.insertions.iter().find(|i| i.participant == name);
        let mut names = expected.trainees.iter().chain(expected.others);
        let count = names.next().and_then(|holder| of(holder));
        let count = count.map(|seen| seen.count as f64);
        let least = expected.insertions as f64;
        let entered = Criterion::new("insertions of the needle", count, Bound::AtLeast, least, "");
        self.0.push(entered);
        for name in names {
            let what = format!("disagreement on the insertion, seen by the {name}");
            let apart_ms = of(name).and_then(|seen| seen.apart_ms);
            self.at_most(what, apart_ms, INSERTION_APART_MS, "ms");
        }
    }

    fn complete(&mut self, report: &Report, expected: &Expected<'_>) {
        let everyone = || expected.trainees.iter().chain(expected.others).copied();
        let died = report.problems.len() as u64;
        self.none_of("processes that died", Some(died));
        let silent = everyone().filter(|name| find(report, name).is_none());
        let silent = silent.count() as u64;
        self.none_of("participants without figures", Some(silent));
        let participants = &report.participants;
        let dropped = participants.iter().map(|p| p.records_dropped).sum();
        let dropped = (!participants.is_empty()).then_some(dropped);
        self.none_of("records dropped from full recordings", dropped);
        let is_unmeasured = |name: &&str| !report.cpu.iter().any(|row| row.process == *name);
        let unmeasured = everyone().chain([SERVER]).filter(is_unmeasured);
        let unmeasured = unmeasured.count() as u64;
        self.none_of("processes without CPU figures", Some(unmeasured));
        let quality = report.reference.as_ref().map(|r| r.quality);
        let residual = quality.map(|q| q.residual_max);
        // Ties of a needle that yield keep the residual at 0.1; the estimated error below is judged all the same.
        if expected.insertions == 0 {
            self.at_most("largest residual of the reference", residual, RESIDUAL, "");
        }
        let what = "distance of a cut from the reference's";
        let apart = report.reference.as_ref().map(|r| r.cut_apart_mm);
        self.at_most(what, apart, CUT_APART_MM, "mm");
        let what = "estimated error of the reference";
        let error = quality.map(|q| q.error_percent.into_iter().fold(0.0, f64::max));
        self.at_most(what, error, REFERENCE_ERROR_PERCENT, "%");
    }
}

fn find<'a>(report: &'a Report, name: &str) -> Option<&'a ParticipantReport> {
    report.participants.iter().find(|p| p.summary.name == name)
}

/// Name of the server in the CPU table.
pub const SERVER: &str = "server";

#[cfg(test)]
mod tests;
