//! The figures of many runs, per class of fault.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::SeedResult;
use super::fault::Class;
use super::oracle::Broken;
use crate::bench::quantile_of_sorted;

/// Maximum number of listed failures.
const LISTED_MAX: usize = 12;

/// A run that broke a law.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Failure {
    /// Seed that replays it.
    pub seed: u64,
    /// Class of its faults.
    pub class: Class,
    /// Its first broken laws.
    pub broken: Vec<Broken>,
}

/// The runs of one class.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ClassOutcome {
    /// Number of runs.
    pub runs: u64,
    /// Runs that broke a law.
    pub failed: u64,
    /// Largest change of force per tick as a share of its limit; 1 is the limit.
    pub step_share_max: f64,
    /// Largest change of force per tick, N.
    pub step_max_n: f64,
    /// Losses of the source under force that lasted until the force was zero.
    pub losses: u64,
    /// Longest time from the loss of a source to zero force, ms.
    pub to_zero_max_ms: f64,
    /// 99th percentile of it, ms.
    pub to_zero_p99_ms: f64,
    /// Smallest share of the fault-free force that returned, at most 1.
    pub back_min: f64,
    /// Ticks with a stale model.
    pub stale: u64,
    /// Ticks without a link.
    pub link_lost: u64,
    /// Rejected models.
    pub bad_models: u64,
    /// Rejected samples.
    pub bad_samples: u64,
    /// Failed readings.
    pub unread: u64,
    /// Writes that the device rejected.
    pub refused: u64,
    /// Writes that the device clamped.
    pub clamped: u64,
    /// Force drops by the device itself.
    pub cuts: u64,
    /// Skipped deadlines.
    pub missed: u64,
    /// Backward jumps of the clock.
    pub put_back: u64,
    #[serde(skip)]
    to_zero_ms: Vec<f64>,
}

/// All runs.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Outcome {
    /// Number of runs.
    pub runs: u64,
    /// Whether no law was broken.
    pub ok: bool,
    /// Longest time from the stop request to zero force, ms.
    pub stop_max_ms: f64,
    /// Results per class.
    pub classes: BTreeMap<Class, ClassOutcome>,
    /// The first runs that broke a law.
    pub failures: Vec<Failure>,
}

impl Outcome {
    /// Adds a run.
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
        let (c, d) = (&run.counters, &run.device);
        for (sum, n) in [
            (&mut row.stale, c.stale),
            (&mut row.link_lost, c.link_lost),
            (&mut row.bad_models, c.bad_models),
            (&mut row.bad_samples, c.bad_samples),
            (&mut row.unread, d.faults),
            (&mut row.refused, d.rejected),
            (&mut row.clamped, d.saturated),
            (&mut row.cuts, d.cuts),
            (&mut row.missed, run.missed),
            (&mut row.put_back, d.clock_put_back),
        ] {
            *sum += n;
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

    /// Number of runs that broke a law.
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
    /// Nonzero counters of the chain and the loop.
    fn counted(&self) -> String {
        let all = [
            ("stale", self.stale),
            ("link lost", self.link_lost),
            ("bad models", self.bad_models),
            ("bad samples", self.bad_samples),
            ("unread", self.unread),
            ("refused", self.refused),
            ("clamped", self.clamped),
            ("cuts", self.cuts),
            ("missed", self.missed),
            ("clock back", self.put_back),
        ];
        let there = all.into_iter().filter(|(_, n)| *n > 0);
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
