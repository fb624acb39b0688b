//! The reference of a demo: its cost, and its distance from a finer one.
//!
//! The finer one has twice as many solves and four times as many checks, and takes about four times as long.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use palpate_tissue::Model;
use serde::Serialize;

use super::Benchmark;
use crate::force_error::ForceError;
use crate::progress::Progress;
use crate::reference::{self, CHECKS, Effort, MOVED_M, Reference};
use crate::scripts::{SECONDS_MAX, SECONDS_MIN, Scripts};
use crate::test_model::TestModel;

/// Options of the bench.
#[derive(Debug, Clone, Args)]
pub struct ReferenceCost {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Length of the scripts, s
    #[arg(long, default_value_t = 20.0, value_name = "S")]
    seconds: f64,
    /// Also compute it with twice as many solves and four times as many checks, and compare
    #[arg(long)]
    finer: bool,
}

/// Result.
#[derive(Debug, Clone, Serialize)]
pub struct ReferenceBench {
    /// Nodes of the model.
    pub nodes: usize,
    /// Length of the scripts, s.
    pub script_s: f64,
    /// Duration, s.
    pub seconds: f64,
    /// Solves near the tools.
    pub solves: usize,
    /// Converged solves of the whole tissue.
    pub checks: usize,
    /// The largest residual of a check.
    pub residual_max: f64,
    /// Change of the force by the checks, percent rms per hand: an upper estimate of the error.
    pub error_percent: [f64; 2],
    /// Duration of the finer reference, s.
    pub finer_seconds: Option<f64>,
    /// Difference of the two references, percent rms per hand.
    pub finer_error_percent: Option<[f64; 2]>,
}

impl Benchmark for ReferenceCost {
    type Report = ReferenceBench;

    fn measure(&self, progress: &mut Progress) -> Result<ReferenceBench, String> {
        let seconds = self.seconds;
        if !(SECONDS_MIN..=SECONDS_MAX).contains(&seconds) {
            return Err(format!(
                "--seconds {seconds} must be from {SECONDS_MIN} to {SECONDS_MAX}"
            ));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        let scripts = Scripts::for_model(&model, seconds)?;
        let mut timed = |name: &str, effort: Effort| {
            progress.stage(name);
            time(&model, &scripts, &effort, progress)
        };
        let (reference, took_s) = timed("computing the reference", Effort::default())?;
        let finer = if self.finer {
            Some(timed(
                "computing a finer reference",
                Effort {
                    moved_m: MOVED_M / 2.0,
                    checks: CHECKS * 4,
                },
            )?)
        } else {
            None
        };
        let q = reference.quality;
        let between = |k: usize, finer: &Reference| {
            ForceError::between(&reference.forces[k], &finer.forces[k])
                .map_or(f64::NAN, |e| e.rms_percent)
        };
        Ok(ReferenceBench {
            nodes: model.nodes.len(),
            script_s: seconds,
            seconds: took_s,
            solves: q.solves,
            checks: q.checks,
            residual_max: q.residual_max,
            error_percent: q.error_percent,
            finer_error_percent: finer.as_ref().map(|(f, _)| [0, 1].map(|k| between(k, f))),
            finer_seconds: finer.map(|(_, s)| s),
        })
    }
}

fn time(
    model: &Arc<Model>,
    scripts: &Scripts,
    effort: &Effort,
    progress: &mut Progress,
) -> Result<(Reference, f64), String> {
    let began = Instant::now();
    let both = [&scripts.holder, &scripts.cutter];
    let reference = reference::run_with(model, both, &[], effort, |share| {
        progress.tick(&format!("{:.0} %", share * 100.0));
        true
    });
    let took_s = began.elapsed().as_secs_f64();
    reference.map(|r| (r, took_s)).map_err(|e| e.to_string())
}

impl fmt::Display for ReferenceBench {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} nodes, scripts of {:.0} s: {:.1} s for {} solves and {} checks to a residual of {:.4}\n\
             checks changed forces by {:.2} and {:.2} %: the error is smaller",
            self.nodes,
            self.script_s,
            self.seconds,
            self.solves,
            self.checks,
            self.residual_max,
            self.error_percent[0],
            self.error_percent[1]
        )?;
        if let Some(([a, b], s)) = self.finer_error_percent.zip(self.finer_seconds) {
            write!(
                f,
                "\na finer one took {s:.1} s; the two differ by {a:.2} and {b:.2} % rms"
            )?;
        }
        Ok(())
    }
}
