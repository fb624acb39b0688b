//! The report of attacks: a table, the failed criteria, and JSON.

use std::fmt;

use serde::Serialize;

use super::AttackOptions;
use super::measures::{Figures, HandFigures, judge};
use crate::criteria::Criterion;

/// The report of attacks.
#[derive(Debug, Clone, Serialize)]
pub struct AttackReport {
    /// Nodes of the model.
    pub nodes: usize,
    /// Length of an attack, s.
    pub seconds: f64,
    /// The network of the honest trainees.
    pub profile: String,
    /// The session without attack.
    pub base: Figures,
    /// The sessions under attack.
    pub runs: Vec<Figures>,
    /// Notes for the reader.
    pub notes: Vec<String>,
    /// Every figure that has a limit.
    pub criteria: Vec<Criterion>,
    /// The failed criteria, one sentence each.
    pub missed: Vec<String>,
    /// Whether all criteria are met.
    pub ok: bool,
}

impl AttackReport {
    /// Judges all runs.
    pub(super) fn new(
        options: &AttackOptions,
        nodes: usize,
        base: Figures,
        runs: Vec<Figures>,
        notes: Vec<String>,
    ) -> Self {
        let judged = |run| judge(run, &base, options.seconds);
        let criteria: Vec<Criterion> = runs.iter().flat_map(judged).collect();
        let failed = criteria.iter().filter(|c| !c.ok);
        let missed: Vec<String> = failed.map(Criterion::to_string).collect();
        Self {
            nodes,
            seconds: options.seconds,
            profile: options.profile.name.clone(),
            ok: missed.is_empty(),
            base,
            runs,
            notes,
            criteria,
            missed,
        }
    }
}

/// The result of one run in a line.
pub(super) fn line(run: &Figures, base: &Figures, seconds: f64) -> String {
    let failed = judge(run, base, seconds).iter().filter(|c| !c.ok).count();
    let verdict = match failed {
        0 => "withstood".to_owned(),
        n => format!("{n} criteria FAILED"),
    };
    format!("{}: {verdict}", run.label())
}

impl fmt::Display for AttackReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "Attacks of {:.0} s on a session of two trainees, model of {} nodes, network {}\n",
            self.seconds, self.nodes, self.profile
        )?;
        writeln!(
            f,
            "{:<24} {:>13} {:>11} {:>11} {:>7} {:>12} {:>7} {:>16} {:>5} {:>7}",
            "",
            "force error %",
            "dropout ms",
            "D ms",
            "demoted",
            "newcomers",
            "memory",
            "recovered s",
            "cuts",
            "log"
        )?;
        writeln!(
            f,
            "{:<24} {:>13} {:>11} {:>11} {:>7} {:>12} {:>7} {:>16} {:>5} {:>7}",
            "",
            "holder cutter",
            "holder cut.",
            "median max",
            "",
            "in/all worst",
            "+MB",
            "join D memory",
            "",
            ""
        )?;
        for run in std::iter::once(&self.base).chain(&self.runs) {
            writeln!(f, "{}", Row(run))?;
        }
        for run in std::iter::once(&self.base).chain(&self.runs) {
            details(f, run)?;
        }
        writeln!(f)?;
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        for sentence in &self.missed {
            writeln!(f, "{sentence}")?;
        }
        let (bad, all) = (self.missed.len(), self.criteria.len());
        if self.ok {
            write!(f, "ok: all {all} criteria passed")
        } else {
            write!(f, "NOT ok: {bad} of {all} criteria failed")
        }
    }
}

fn details(f: &mut fmt::Formatter<'_>, run: &Figures) -> fmt::Result {
    let is_plain = run.server_cpu.is_none()
        && run.achieved.is_empty()
        && run.newcomers.reasons.is_empty()
        && run.problems.is_empty();
    if is_plain {
        return Ok(());
    }
    writeln!(f, "\n{}", run.label())?;
    if let Some(cpu) = &run.server_cpu {
        let classes = cpu
            .classes
            .iter()
            .map(|(class, cores)| format!("{class} {cores:.3}"));
        let classes: Vec<String> = classes.collect();
        writeln!(
            f,
            "  server: {:.3} cores ({})",
            cpu.cores,
            classes.join(", ")
        )?;
    }
    for (name, counts) in &run.achieved {
        let counts: Vec<String> = counts.iter().map(|(k, n)| format!("{n} {k}")).collect();
        writeln!(f, "  {name} achieved: {}", counts.join(", "))?;
    }
    for why in &run.newcomers.reasons {
        writeln!(f, "  newcomer: {why}")?;
    }
    for problem in &run.problems {
        writeln!(f, "  PROBLEM: {problem}")?;
    }
    Ok(())
}

/// A number, or a dash if it is missing.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |v| format!("{v:.digits$}"))
}

/// A line of the table.
struct Row<'a>(&'a Figures);

impl fmt::Display for Row<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let run = self.0;
        let hands = |of: fn(&HandFigures) -> Option<f64>, digits: usize| {
            let each: Vec<String> = run.hands.iter().map(|h| number(of(h), digits)).collect();
            each.join(" ")
        };
        let delay = run.delay;
        let (n, r) = (&run.newcomers, run.recovery);
        let recovered = [r.newcomer_s, r.delay_s, r.memory_s].map(|s| number(s, 1));
        let cuts = run.honest_cuts.map_or("-".to_owned(), |n| n.to_string());
        let log = run.operations.map_or("-".to_owned(), |n| n.to_string());
        write!(
            f,
            "{:<24} {:>13} {:>11} {:>11} {:>7} {:>12} {:>7} {:>16} {:>5} {:>7}",
            run.label(),
            hands(|h| h.force_error_percent, 1),
            hands(|h| h.longest_dropout_ms, 0),
            format!(
                "{} {}",
                number(delay.map(|d| d.median_ms), 1),
                number(delay.map(|d| d.max_ms), 1)
            ),
            run.demotions.map_or("-".to_owned(), |n| n.to_string()),
            format!("{}/{} {}", n.joined, n.attempts, number(n.slowest_s, 2)),
            number(run.memory.map(|m| m.growth_mb()), 0),
            recovered.join(" "),
            format!("{cuts}/{}", run.strokes),
            log
        )
    }
}
