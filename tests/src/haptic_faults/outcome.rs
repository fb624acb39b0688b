//! The figures of many runs, per class of fault.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::SeedResult;
use super::fault::Class;
use super::oracle::Broken;
use super::run::Run;
use crate::bench::quantile_of_sorted;

const LISTED_MAX: usize = 12;

/// Name in JSON, name in the text, and the count of a run.
type Counter = (&'static str, &'static str, fn(&Run) -> u64);

/// Counters that are summed.
const COUNTED: [Counter; 10] = [
    ("stale", "stale", |r| r.counters.stale),
    ("link_lost", "link lost", |r| r.counters.link_lost),
    ("bad_models", "bad models", |r| r.counters.bad_models),
    ("bad_samples", "bad samples", |r| r.counters.bad_samples),
    ("unread", "unread", |r| r.device.faults),
    ("refused", "refused", |r| r.device.rejected),
    ("clamped", "clamped", |r| r.device.saturated),
    ("cuts", "cuts", |r| r.device.cuts),
    ("missed", "missed", |r| r.missed),
    ("put_back", "clock back", |r| r.device.clock_put_back),
];

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Failure {
    pub seed: u64,
    pub class: Class,
    pub broken: Vec<Broken>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ClassOutcome {
    pub runs: u64,
    pub failed: u64,
    /// Largest change of force per tick as a share of its limit; 1 is the limit.
    pub step_share_max: f64,
    /// Largest change of force per tick, N.
    pub step_max_n: f64,
    /// Losses of the source under force that lasted until the force was zero.
    pub losses: u64,
    /// Longest time from the loss of a source to zero force, ms.
    pub to_zero_max_ms: f64,
    pub to_zero_p99_ms: f64,
    /// Smallest share of the fault-free force that returned, at most 1.
    pub back_min: f64,
    /// Counters of the chain and the loop, by name.
    #[serde(flatten)]
    pub counts: BTreeMap<&'static str, u64>,
    #[serde(skip)]
    to_zero_ms: Vec<f64>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Outcome {
    pub runs: u64,
    pub ok: bool,
    /// Longest time from the stop request to zero force, ms.
    pub stop_max_ms: f64,
    pub classes: BTreeMap<Class, ClassOutcome>,
    pub failures: Vec<Failure>,
}

impl Outcome {
    pub fn take(&mut self, result: &SeedResult) {
        self.runs += 1;
        let (run, class) = (&result.faulty, result.plan.class);
        self.stop_max_ms = self.stop_max_ms.max(run.stop_ms);
        let row = self.classes.entry(class).or_insert_with(|| ClassOutcome {
            back_min: 1.0,
            ..ClassOutcome::default()
        });
        let back = run.back_share(&result.fault_free).unwrap_or(1.0);
        row.back_min = row.back_min.min(back);
        row.runs += 1;
        row.step_share_max = row.step_share_max.max(run.max_delta_n / run.step_n);
        row.step_max_n = row.step_max_n.max(run.max_delta_n);
        row.to_zero_ms.extend(&run.to_zero_ms);
        for (name, _, of) in COUNTED {
            *row.counts.entry(name).or_default() += of(run);
        }
        if !run.broken.is_empty() {
            row.failed += 1;
            if self.failures.len() < LISTED_MAX {
                self.failures.push(Failure {
                    seed: result.plan.seed,
                    class,
                    broken: run.broken.clone(),
                });
            }
        }
    }

    pub fn failed(&self) -> u64 {
        self.classes.values().map(|row| row.failed).sum()
    }

    /// Computes the totals after the last run.
    pub fn settle(&mut self) {
        self.ok = self.failed() == 0;
        for row in self.classes.values_mut() {
            row.to_zero_ms.sort_by(f64::total_cmp);
            let times = &row.to_zero_ms;
            row.losses = times.len() as u64;
            row.to_zero_max_ms = times.last().copied().unwrap_or(0.0);
            row.to_zero_p99_ms = quantile_of_sorted(times, 0.99).unwrap_or(0.0);
        }
    }
}

impl ClassOutcome {
    fn counted(&self) -> String {
        let there = COUNTED.map(|(name, what, _)| (what, self.counts[name]));
        let there = there.into_iter().filter(|(_, n)| *n > 0);
        let words: Vec<String> = there.map(|(what, n)| format!("{what} {n}")).collect();
        words.join(", ")
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<13} {:>6} {:>7} {:>9} {:>9} {:>7} {:>9} {:>9} {:>7}  counted",
            "fault",
            "runs",
            "failed",
            "step / N",
            "of limit",
            "losses",
            "p99 / ms",
            "max / ms",
            "back"
        )?;
        for (class, row) in &self.classes {
            writeln!(
                f,
                "{class:<13} {:>6} {:>7} {:>9.4} {:>7.2} % {:>7} {:>9.1} {:>9.1} {:>5.0} %  {}",
                row.runs,
                row.failed,
                row.step_max_n,
                row.step_share_max * 100.0,
                row.losses,
                row.to_zero_p99_ms,
                row.to_zero_max_ms,
                row.back_min * 100.0,
                row.counted()
            )?;
        }
        writeln!(
            f,
            "step: largest change of force per tick; losses: of the source, felt until the force was zero, and how long \
             that took (at most 150 ms); back: least part of the force without the fault that was there again afterwards. \
             To stop at the end took at most {:.1} ms.",
            self.stop_max_ms
        )?;
        for failure in &self.failures {
            writeln!(f, "seed {} ({}):", failure.seed, failure.class)?;
            for broken in &failure.broken {
                writeln!(
                    f,
                    "  {:8.1} ms  {}: {}",
                    broken.at_ms, broken.law, broken.detail
                )?;
            }
        }
        if self.ok {
            write!(f, "{} runs, and no hand was jerked", self.runs)
        } else {
            let failed = self.failed();
            write!(
                f,
                "{failed} of {} runs broke a law; --seed S replays one",
                self.runs
            )
        }
    }
}
