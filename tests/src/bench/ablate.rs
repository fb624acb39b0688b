//! `ablate`: force error and time of a hand's steps with one mechanism of the solver switched off at a time.
//!
//! A sphere presses, slides along the surface and withdraws at the speed of a hand; in one scene a cut is made
//! beside it. The forces are compared with converged solutions at the same tool poses. Steps are limited by
//! iterations and not by time, so the errors of two runs are equal.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use palpate_tissue::{
    Budget, CutPreparer, Mechanism, Model, PreparedCut, Tissue, Tool, Topology, Vec3,
};
use serde::Serialize;

use super::wound::Wound;
use super::{Benchmark, OnStage};
use crate::test_model::TestModel;
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const TICK_S: f64 = 4e-3;
/// Maximum depth, m, and as a share of the soft tissue.
const DEPTH_MAX_M: f64 = 15e-3;
const DEPTH_SHARE: f64 = 0.5;
/// Speed of pressing and withdrawing, and of sliding, m/s.
const PRESS_M_S: f64 = 0.1;
const SLIDE_M_S: f64 = 0.05;
/// Speed of the fast strokes into the tissue and out, m/s, and their number.
const FAST_M_S: f64 = 0.4;
const FAST_STROKES: usize = 3;
/// Strokes of a hand whose solver misses ticks, and their depths, in shares of the whole.
const JUMPS: usize = 6;
const JUMP_DEPTHS: [f64; 7] = [0.3, 0.6, 1.0, 1.0, 1.0, 0.4, 0.0];
/// Ticks of a slide.
const SLIDE: usize = 60;
/// Tolerance of a quick step.
const QUICK: f64 = 2.5e-2;
/// Maximum iterations and tolerance of the converged solution.
const CONVERGED: (usize, f64) = (200, 1e-4);
/// In phases before `FAST`, poses between two converged solutions.
const CONVERGED_EVERY: usize = 3;
/// Times that each variant is measured; the fastest counts for every tick.
const REPEATS: usize = 2;
const PHASES: [&str; 5] = ["press", "slide", "withdraw", "fast", "jump"];
/// Phases from here on have poses so far apart that a reference that skips some loses the contact.
const FAST: usize = 3;

#[derive(Debug, Clone, Copy, Serialize)]
pub struct PhaseFigures {
    /// Rms of the force error relative to the rms of the force, percent.
    pub rms_percent: f64,
    /// Largest force error relative to the largest force, percent.
    pub max_percent: f64,
    /// Mean time per tick, ms.
    pub ms: f64,
    /// Longest tick, ms: a mean hides the tick that a hand feels.
    pub ms_max: f64,
    /// Mean evaluations of bricks and of coarse elements per tick, which no other load changes.
    pub visits: [f64; 2],
}

/// Figures of the solver without one mechanism, or of the whole solver.
#[derive(Debug, Clone, Serialize)]
pub struct Variant {
    /// Name of the mechanism that is switched off; `none` for the whole solver.
    pub without: &'static str,
    pub phases: [PhaseFigures; PHASES.len()],
}

#[derive(Debug, Clone, Serialize)]
pub struct Ablation {
    pub scene: String,
    pub nodes: usize,
    pub converged_residual: f64,
    /// The whole solver first, then one variant per mechanism.
    pub variants: Vec<Variant>,
}

struct Course {
    name: String,
    tissue: Tissue,
    /// Tool pose and phase of every tick.
    ticks: Vec<(Tool, usize)>,
    /// The cut at the beginning of the slide.
    cut: Option<(CutPreparer, PreparedCut)>,
}

#[derive(Debug, Clone, Copy)]
struct Step {
    /// Force on the tool, N.
    force: Vec3,
    ms: f64,
    visits: [usize; 2],
}

/// The steps of a course; `None` where no step was made.
type Run = Vec<Option<Step>>;

impl Course {
    fn new(name: &str, model: Arc<Model>, cuts: bool) -> Result<Self, String> {
        let tissue = Tissue::new(model);
        let found = ToolLocation::find(tissue.topology());
        let mut place = found.map_err(|e| format!("{name}: {e}"))?;
        place.sag(&tissue);
        let cut = if cuts {
            let mut after = Topology::clone(tissue.topology());
            let (_, stroke) = Wound::open(&mut after, &mut place)?;
            let mut preparer = tissue.preparer();
            let cut = preparer.prepare(&stroke).map_err(|e| e.to_string())?;
            Some((preparer, cut))
        } else {
            None
        };
        let depth_max = DEPTH_MAX_M.min(DEPTH_SHARE * place.depth_m);
        let down = (depth_max / (PRESS_M_S * TICK_S)).ceil() as usize;
        let at = |depth: f64, along: f64| {
            let from = place.middle + place.v * along;
            Tool::ball(1, from + place.normal * (RADIUS_M - depth), RADIUS_M)
        };
        let depth = |k: usize| (k as f64 * PRESS_M_S * TICK_S).min(depth_max);
        let end = SLIDE as f64 * SLIDE_M_S * TICK_S;
        let press = (1..=down).map(|k| (at(depth(k), 0.0), 0));
        let slide = (1..=SLIDE).map(|k| (at(depth_max, k as f64 * SLIDE_M_S * TICK_S), 1));
        let withdraw = (0..down).rev().map(|k| (at(depth(k), end), 2));
        let turn = (depth_max / (FAST_M_S * TICK_S)).ceil() as usize;
        let stroke = (1..=turn).chain((0..turn).rev());
        let fast = (0..FAST_STROKES).flat_map(|_| stroke.clone()).map(|k| {
            let depth = (k as f64 * FAST_M_S * TICK_S).min(depth_max);
            (at(depth, end), FAST)
        });
        let jump = (0..JUMPS).flat_map(|n| JUMP_DEPTHS.map(|share| (n, share)));
        let jump = jump.map(|(n, share)| {
            let along = end * (n % 3) as f64 / 2.0 * share.max(0.5);
            (at(depth_max * share, along), FAST + 1)
        });
        Ok(Self {
            name: name.to_owned(),
            ticks: press
                .chain(slide)
                .chain(withdraw)
                .chain(fast)
                .chain(jump)
                .collect(),
            tissue,
            cut,
        })
    }

    /// Runs the course on a fresh solver. Returns the largest residual too.
    fn run(
        &self,
        without: Option<Mechanism>,
        (iterations, tolerance): (usize, f64),
        every: usize,
    ) -> (Run, f64) {
        let mut tissue = self.tissue.another();
        if let Some(mechanism) = without {
            tissue.disable(mechanism);
        }
        let mut residual = 0.0f64;
        let mut run = Vec::with_capacity(self.ticks.len());
        let mut phase_before = 0;
        for &(tool, phase) in &self.ticks {
            if let Some((preparer, cut)) = &self.cut
                && phase == 1
                && phase_before == 0
            {
                tissue.succeed(preparer.repeat(cut));
            }
            phase_before = phase;
            if run.len() % every != 0 && phase < FAST {
                run.push(None);
                continue;
            }
            let budget = Budget {
                near: tolerance == QUICK,
                ..Budget::new(iterations, tolerance)
            };
            let began = Instant::now();
            let report = tissue.step(&[tool], budget);
            let ms = began.elapsed().as_secs_f64() * 1e3;
            residual = residual.max(report.residual);
            let force = report
                .reactions
                .first()
                .map_or_else(Vec3::zeros, |r| r.force);
            run.push(Some(Step {
                force,
                ms,
                visits: report.visits,
            }));
        }
        (run, residual)
    }

    fn figures(&self, run: &Run, converged: &Run) -> [PhaseFigures; PHASES.len()] {
        std::array::from_fn(|phase| {
            let in_phase = |run: &Run| -> Vec<Option<Step>> {
                let all = self.ticks.iter().zip(run);
                let of_phase = all.filter(|((_, p), _)| *p == phase);
                of_phase.map(|(_, step)| *step).collect()
            };
            let (steps, exact) = (in_phase(run), in_phase(converged));
            let (mut error, mut force, mut worst, mut most) = (0.0, 0.0, 0.0f64, 0.0f64);
            for (step, exact) in steps.iter().zip(&exact) {
                let Some((step, exact)) = step.zip(*exact) else {
                    continue;
                };
                let off = (step.force - exact.force).norm();
                error += off.powi(2);
                force += exact.force.norm_squared();
                worst = worst.max(off);
                most = most.max(exact.force.norm());
            }
            let mean = |of: &dyn Fn(&Step) -> f64| {
                steps.iter().flatten().map(of).sum::<f64>() / steps.len() as f64
            };
            PhaseFigures {
                rms_percent: 100.0 * (error / force).sqrt(),
                max_percent: 100.0 * worst / most,
                ms: mean(&|step| step.ms),
                ms_max: steps
                    .iter()
                    .flatten()
                    .map(|step| step.ms)
                    .fold(0.0, f64::max),
                visits: [0, 1].map(|k| mean(&|step| step.visits[k] as f64)),
            }
        })
    }

    fn ablate(
        &self,
        mechanisms: &[Mechanism],
        iterations: usize,
        progress: &mut OnStage<'_>,
    ) -> Ablation {
        progress(&format!("{}: converged solutions", self.name));
        let (converged, converged_residual) = self.run(None, CONVERGED, CONVERGED_EVERY);
        let variants = [None]
            .into_iter()
            .chain(mechanisms.iter().copied().map(Some));
        let variants = variants.map(|mechanism| {
            let without = mechanism.map_or("none", Mechanism::name);
            progress(&format!("{}: without {without}", self.name));
            let (mut fastest, _) = self.run(mechanism, (iterations, QUICK), 1);
            for _ in 1..REPEATS {
                let (again, _) = self.run(mechanism, (iterations, QUICK), 1);
                for (tick, again) in fastest.iter_mut().flatten().zip(again.iter().flatten()) {
                    tick.ms = tick.ms.min(again.ms);
                }
            }
            Variant {
                without,
                phases: self.figures(&fastest, &converged),
            }
        });
        Ablation {
            scene: self.name.clone(),
            nodes: self.tissue.topology().node_count(),
            converged_residual,
            variants: variants.collect(),
        }
    }
}

/// Options of `ablate`.
#[derive(Debug, Clone, Args)]
pub struct Ablate {
    /// Model files (.palp), scenes (.toml) or samples: thigh, abdominal-wall, leg, handle. The first is also cut
    #[arg(default_values_t = ["thigh".to_owned(), "abdominal-wall".to_owned()])]
    models: Vec<String>,
    /// Switch off only this mechanism; may be repeated
    #[arg(long = "mechanism", value_name = "NAME", value_parser = mechanisms())]
    mechanisms: Vec<Mechanism>,
    /// Maximum iterations per step: a hand has 4, a view 1
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=100))]
    iterations: u8,
}

fn mechanisms() -> impl TypedValueParser<Value = Mechanism> {
    let names = Mechanism::ALL.iter().map(|m| m.name());
    PossibleValuesParser::new(names).try_map(|name| {
        let known = Mechanism::ALL.iter().find(|m| m.name() == name);
        known.copied().ok_or("no such mechanism")
    })
}

#[derive(Debug, Clone, Serialize)]
pub struct Ablations {
    pub scenes: Vec<Ablation>,
}

impl Benchmark for Ablate {
    type Report = Ablations;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<Ablations, String> {
        let mechanisms: &[Mechanism] = match &self.mechanisms[..] {
            [] => Mechanism::ALL,
            some => some,
        };
        let iterations = usize::from(self.iterations);
        let mut scenes = Vec::new();
        for (index, name) in self.models.iter().enumerate() {
            let model = TestModel::in_memory(name, progress)?;
            let mut ablate = |name: &str, cuts: bool| {
                let model = Arc::clone(&model);
                let run = || -> Result<Ablation, String> {
                    let course = Course::new(name, model, cuts)?;
                    Ok(course.ablate(mechanisms, iterations, progress))
                };
                super::on_threads(1, run)?
            };
            scenes.push(ablate(name, false)?);
            if index == 0 {
                scenes.push(ablate(&format!("{name}, cut"), true)?);
            }
        }
        Ok(Ablations { scenes })
    }
}

impl fmt::Display for Ablations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, scene) in self.scenes.iter().enumerate() {
            write!(f, "{}{scene}", if index == 0 { "" } else { "\n\n" })?;
        }
        Ok(())
    }
}

impl fmt::Display for Ablation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} ({} nodes): force error rms and max in %, mean and longest tick in ms, bricks and coarse elements per tick; converged to {:.0e}",
            self.scene, self.nodes, self.converged_residual
        )?;
        write!(f, "{:<20}", "without")?;
        for phase in PHASES {
            write!(f, " | {phase:^40}")?;
        }
        for variant in &self.variants {
            write!(f, "\n{:<20}", variant.without)?;
            for p in variant.phases {
                let [bricks, coarse] = p.visits;
                write!(
                    f,
                    " | {:>6.2} {:>6.2} {:>6.2} {:>6.2} {bricks:>5.0} {coarse:>6.0}",
                    p.rms_percent, p.max_percent, p.ms, p.ms_max
                )?;
            }
        }
        Ok(())
    }
}
