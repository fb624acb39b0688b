//! The figures of many runs, per class of fault.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::Trial;
use super::fault::Class;
use super::oracle::Broken;

/// Failures that are listed; more say nothing new.
const LISTED_MAX: usize = 12;

/// A run that broke a law.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Failure {
    /// Replays it.
    pub seed: u64,
    /// What was broken in it.
    pub class: Class,
    /// The laws that it broke, the first ones.
    pub broken: Vec<Broken>,
}

/// The runs of one class.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ClassOutcome {
    /// How many.
    pub runs: u64,
    /// Those that broke a law.
    pub failed: u64,
    /// Largest change of force per tick as a share of its limit; 1 is the limit.
    pub step_share_max: f64,
    /// Largest change of force per tick, N.
    pub step_max_n: f64,
    /// Losses of the source under force, and none came back before the force was zero.
    pub losses: u64,
    /// From the loss of a source to zero force, ms: the longest.
    pub to_zero_max_ms: f64,
    /// The same, 99 of 100.
    pub to_zero_p99_ms: f64,
    /// The smallest part of the force without faults that was back afterwards, at most 1.
    pub back_min: f64,
    /// Ticks with an old model.
    pub stale: u64,
    /// Ticks without a link.
    pub link_lost: u64,
    /// Models that were refused.
    pub bad_models: u64,
    /// Samples that were refused.
    pub bad_samples: u64,
    /// Readings that failed.
    pub unread: u64,
    /// Writes that the device refused.
    pub refused: u64,
    /// Writes that it clamped.
    pub clamped: u64,
    /// Times that it took its force away by itself.
    pub cuts: u64,
    /// Deadlines that were skipped.
    pub missed: u64,
    /// Times that the clock was put back.
    pub put_back: u64,
    #[serde(skip)]
    to_zero_ms: Vec<f64>,
}

/// All runs.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Outcome {
    /// How many.
    pub runs: u64,
    /// Whether no law was broken.
    pub ok: bool,
    /// The longest from the wish to stop, at the end of a run, to zero force, ms.
    pub stop_max_ms: f64,
    /// Per class.
    pub classes: BTreeMap<Class, ClassOutcome>,
    /// Runs that broke a law, the first ones.
    pub failures: Vec<Failure>,
}

impl Outcome {
    /// Adds a run.
    pub fn take(&mut self, trial: &Trial) {
        self.runs += 1;
        let (run, class) = (&trial.run, trial.plan.class);
        self.stop_max_ms = self.stop_max_ms.max(run.stop_ms);
        let row = self.classes.entry(class).or_insert_with(|| ClassOutcome {
            back_min: 1.0,
            ..ClassOutcome::default()
        });
        let back = run.back_share(&trial.without).unwrap_or(1.0);
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
                    seed: trial.plan.seed,
                    class,
                    broken: run.broken.clone(),
                });
            }
        }
    }

    /// Runs that broke a law so far.
    pub fn failed(&self) -> u64 {
        self.classes.values().map(|row| row.failed).sum()
    }

    /// Adds up, when all runs are there.
    pub fn settle(&mut self) {
        self.ok = self.failed() == 0;
        for row in self.classes.values_mut() {
            row.to_zero_ms.sort_by(f64::total_cmp);
            let times = &row.to_zero_ms;
            let at = |q: f64| ((times.len() as f64 * q).ceil() as usize).max(1) - 1;
            row.losses = times.len() as u64;
            row.to_zero_max_ms = times.last().copied().unwrap_or(0.0);
            row.to_zero_p99_ms = times.get(at(0.99)).copied().unwrap_or(0.0);
        }
    }
}

impl ClassOutcome {
    /// What the chain and the loop counted, without what was counted never.
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
