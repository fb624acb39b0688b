//! The criteria of a demo: a table of figures and their limits.
//!
//! A missing figure fails its criterion.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::report::{ParticipantReport, Report};

/// Maximum error of the contact force, percent rms.
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

/// Side of a limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    /// Not above it.
    AtMost,
    /// Not below it.
    AtLeast,
}

/// A figure and its limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Criterion {
    /// The figure.
    pub criterion: String,
    /// Its value; `None` if missing.
    pub value: Option<f64>,
    /// Its limit.
    pub limit: f64,
    /// The side of the limit.
    pub bound: Bound,
    /// The unit of both; empty for counts.
    pub unit: String,
    /// Whether the figure exists and is within its limit.
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

/// A number with as many digits as it needs.
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

/// Expected figures of a session.
#[derive(Debug, Clone, Copy)]
pub struct Expected<'a> {
    /// Names of the trainees.
    pub trainees: &'a [&'a str],
    /// Names of all other participants.
    pub others: &'a [&'a str],
    /// Strokes of the blade in the scripts; each one is a cut.
    pub strokes: u64,
    /// Maximum D, ms; `None` if D is not judged.
    pub delay_limit_ms: Option<f64>,
    /// Whether the maximum delay covers the network, so that no participant may be demoted.
    pub is_covered: bool,
}

/// All criteria of a report, the most important first.
pub fn judge(report: &Report, expected: &Expected<'_>) -> Vec<Criterion> {
    let mut table = Vec::new();
    for name in expected.trainees {
        hand(report, name, &mut table);
    }
    shared(report, expected, &mut table);
    complete(report, expected, &mut table);
    table
}

fn find<'a>(report: &'a Report, name: &str) -> Option<&'a ParticipantReport> {
    report.participants.iter().find(|p| p.name == name)
}

/// Criteria of the force on one trainee.
fn hand(report: &Report, name: &str, table: &mut Vec<Criterion>) {
    let longest_ms = DROPOUT_MS[usize::from(report.stress > 0)];
    let p = find(report, name);
    let dropouts = p.and_then(|p| p.dropouts.as_ref());
    table.extend([
        Criterion::at_most(
            format!("force error of the {name}"),
            p.and_then(|p| p.force_error_rms),
            FORCE_ERROR_PERCENT,
            "%",
        ),
        Criterion::at_most(
            format!("longest dropout of the {name}"),
            dropouts.map(|d| d.longest_ms),
            longest_ms,
            "ms",
        ),
        Criterion::new(
            format!("largest force on the {name}"),
            p.map(|p| p.summary.force_max_n),
            Bound::AtLeast,
            TOUCH_N,
            "N",
        ),
        Criterion::at_most(
            format!("longest gap in the recorded force of the {name}"),
            p.and_then(|p| p.recording_gap_ms),
            longest_ms,
            "ms",
        ),
    ]);
}

/// Criteria of the whole session.
fn shared(report: &Report, expected: &Expected<'_>, table: &mut Vec<Criterion>) {
    let participants = &report.participants;
    if let Some(limit_ms) = expected.delay_limit_ms {
        let largest = report.delay.map(|d| d.max_ms);
        table.push(Criterion::at_most(
            "largest playout delay D",
            largest,
            limit_ms,
            "ms",
        ));
    }
    if expected.is_covered {
        let demoted = participants.iter().map(|p| p.summary.demotions).sum();
        let demotions = report.server.demotions.max(demoted);
        table.push(Criterion::none_of(
            "demotions to spectator",
            Some(demotions),
        ));
    }
    let arrived = participants.iter().map(|p| p.summary.cuts);
    let arrived = arrived.min().map(|n| n.min(report.cut.operations));
    let lost = arrived.map(|n| expected.strokes.saturating_sub(n));
    table.push(Criterion::none_of("lost cuts", lost));
    let server = &report.server.topology_hash;
    let differ = participants.iter().filter(|p| p.topology_hash != *server);
    let differ = (!participants.is_empty()).then_some(differ.count() as u64);
    table.push(Criterion::none_of(
        "topologies that differ from the server's",
        differ,
    ));
    let is_open = !report.cut.boundary_closed;
    table.push(Criterion::none_of(
        "open outer surfaces",
        Some(u64::from(is_open)),
    ));
}

/// Criteria of completeness.
fn complete(report: &Report, expected: &Expected<'_>, table: &mut Vec<Criterion>) {
    let everyone = || expected.trainees.iter().chain(expected.others);
    let count = |is_missing: &dyn Fn(&str) -> bool| {
        Some(everyone().filter(|name| is_missing(name)).count() as u64)
    };
    let reference = report.reference.as_ref();
    let largest = |v: [f64; 2]| v.into_iter().fold(0.0, f64::max);
    table.extend([
        Criterion::none_of("processes that died", Some(report.problems.len() as u64)),
        Criterion::none_of(
            "participants without figures",
            count(&|name| find(report, name).is_none()),
        ),
        Criterion::none_of(
            "records dropped from full recordings",
            (!report.participants.is_empty())
                .then(|| report.participants.iter().map(|p| p.records_dropped).sum()),
        ),
        Criterion::none_of(
            "processes without CPU figures",
            count(&|name| !report.cpu.iter().any(|row| row.process == name))
                .map(|n| n + u64::from(!report.cpu.iter().any(|row| row.process == SERVER))),
        ),
        Criterion::at_most(
            "largest residual of the reference",
            reference.map(|r| r.residual_max),
            RESIDUAL,
            "",
        ),
        Criterion::at_most(
            "distance of a cut from the reference's",
            reference.map(|r| r.cut_apart_mm),
            CUT_APART_MM,
            "mm",
        ),
        Criterion::at_most(
            "estimated error of the reference",
            reference.map(|r| largest(r.error_percent)),
            REFERENCE_ERROR_PERCENT,
            "%",
        ),
    ]);
}

/// Name of the server in the CPU table.
pub const SERVER: &str = "server";

#[cfg(test)]
mod tests;
