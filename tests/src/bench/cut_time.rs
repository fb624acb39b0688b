//! `bench cut-time`: price of one blade sample against the size of the model (fig 7.13).
//!
//! A blade cuts straight through the middle of a block at constant speed, under a pressing ball. Every sample adds
//! 1 mm of path; each cut also has the path of three spacings before it, so that the sheet continues. Processor time of
//! one thread, without other work: the topology and the change of the levels, the hand's tissue that follows, and its
//! next step.

use std::fmt;
use std::sync::Arc;

use clap::Args;
use palpate_client::realtime::worked;
use palpate_tissue::{BladePoint, Budget, CutError, CutStroke, Tissue, Tool, Vec3};
use serde::Serialize;

use super::{Benchmark, OnStage, on_threads, quantile};
use crate::test_model::soft_block;

/// Lattice spacing, m.
const SPACING_M: f64 = 4e-3;
/// Path of a sample, m.
const SAMPLE_M: f64 = 1e-3;
/// Samples of earlier path in each cut: three spacings.
const OVERLAP: usize = 12;
/// Depth of the blade, m.
const DEPTH_M: f64 = 0.018;
/// Radius and depth of the ball, m.
const BALL_M: [f64; 2] = [8e-3, 4e-3];

#[derive(Debug, Clone, Args)]
pub struct CutTime {
    /// Nodes per edge of the blocks: 22 makes 10,000 nodes, 46 97,000, 100 a million
    #[arg(long, value_delimiter = ',', default_values_t = [22, 46], value_parser = clap::value_parser!(u16).range(12..=120))]
    nodes: Vec<u16>,
    /// Blade samples
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u16).range(10..=1000))]
    samples: u16,
}

/// Processor times in ms.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Times {
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub max_ms: f64,
}

impl Times {
    fn of(times: &[f64]) -> Self {
        Self {
            p50_ms: quantile(times, 0.5),
            p99_ms: quantile(times, 0.99),
            max_ms: quantile(times, 1.0),
        }
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct SizeReport {
    pub nodes: usize,
    /// Samples that opened faces; the others are between two planes of cells.
    pub opening: usize,
    /// Topology and change of the levels, over all samples.
    pub cut: Times,
    /// The hand's tissue follows, over the opening samples.
    pub follow: Times,
    /// The hand's step after an opening sample, and without one.
    pub step: Times,
    pub quiet_step: Times,
}

#[derive(Debug, Clone, Serialize)]
pub struct CutTimeReport {
    pub sizes: Vec<SizeReport>,
}

impl Benchmark for CutTime {
    type Report = CutTimeReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<CutTimeReport, String> {
        let mut sizes = Vec::new();
        for &nodes in &self.nodes {
            progress(&format!("cutting a block of {nodes} nodes per edge"));
            sizes.push(on_threads(1, || self.run(usize::from(nodes) - 1))??);
        }
        Ok(CutTimeReport { sizes })
    }
}

impl CutTime {
    fn run(&self, cells: usize) -> Result<SizeReport, String> {
        let model = Arc::new(soft_block([cells; 3], SPACING_M));
        let side = cells as f64 * SPACING_M;
        let mut tissue = Tissue::new(model);
        let mut preparer = tissue.preparer();
        let ball = |k: usize| {
            let [radius, depth] = BALL_M;
            // It trembles, so that every step solves.
            let height = side + radius - depth + 0.05e-3 * f64::from(k as u32 % 2);
            Tool::ball(1, Vec3::new(0.5 * side, 0.5 * side + 0.012, height), radius)
        };
        let hand = || Budget {
            near: true,
            ..Budget::new(4, 0.02)
        };
        for k in 0..50 {
            tissue.step(&[ball(k)], hand());
        }
        // Off the planes of the lattice, towards the ball from 30 mm away.
        let start = Vec3::new(0.5 * side - 0.03, 0.5 * side + 0.3 * SPACING_M, side);
        let point = |k: usize| BladePoint {
            tip: start + Vec3::new(SAMPLE_M * k as f64, 0.0, -DEPTH_M),
            axis: Vec3::z(),
            depth_m: DEPTH_M + SPACING_M,
        };
        let ms = |from| (worked() - from).as_secs_f64() * 1e3;
        let (mut cuts, mut follows) = (Vec::new(), Vec::new());
        let (mut steps, mut quiet_steps) = (Vec::new(), Vec::new());
        for k in OVERLAP..OVERLAP + usize::from(self.samples) {
            let stroke = CutStroke {
                points: (k - OVERLAP..=k).map(point).collect(),
                width_m: 0.0,
            };
            let from = worked();
            let cut = preparer.prepare(&stroke);
            cuts.push(ms(from));
            let is_opening = match cut {
                Ok(cut) => {
                    let from = worked();
                    let retired = tissue.succeed(cut);
                    follows.push(ms(from));
                    drop(retired);
                    true
                }
                Err(CutError::NothingNew) => false,
                Err(error) => return Err(error.to_string()),
            };
            for step in 0..4 {
                let from = worked();
                tissue.step(&[ball(k + step)], hand());
                let times = if is_opening && step == 0 {
                    &mut steps
                } else {
                    &mut quiet_steps
                };
                times.push(ms(from));
            }
        }
        Ok(SizeReport {
            nodes: tissue.topology().node_count(),
            opening: follows.len(),
            cut: Times::of(&cuts),
            follow: Times::of(&follows),
            step: Times::of(&steps),
            quiet_step: Times::of(&quiet_steps),
        })
    }
}

impl fmt::Display for CutTimeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "processor time of a blade sample of 1 mm, ms: 50 %, 99 %, most"
        )?;
        write!(
            f,
            "{:>9} {:>7} {:>22} {:>22} {:>22} {:>22}",
            "nodes", "opening", "cut", "follow", "next step", "other steps"
        )?;
        for size in &self.sizes {
            write!(f, "\n{:>9} {:>7}", size.nodes, size.opening)?;
            for t in [size.cut, size.follow, size.step, size.quiet_step] {
                write!(f, " {:>6.2} {:>7.2} {:>7.2}", t.p50_ms, t.p99_ms, t.max_ms)?;
            }
        }
        Ok(())
    }
}
