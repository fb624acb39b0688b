//! `bench press-scene`: a sphere pressed into any model at the speed of a hand.
//!
//! A sphere of 8 mm radius moves 15 mm deep at 100 mm/s, if the model has room, and back. It is solved at 250
//! Hz with the budget of a hand, several times from rest. A second solver converges at every tool position, and
//! the forces are compared.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use palpate_tissue::{Budget, Model, StepReport, Tissue, Tool, Topology};
use serde::Serialize;

use super::wound::Wound;
use super::{Benchmark, OnStage, on_threads};
use crate::test_model::TestModel;
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
const TICK_S: f64 = 4e-3;
const REST: usize = 5;
/// Minimum force for a relative error, N.
const LEAST_N: f64 = 2e-3;
const TOLERANCE: f64 = 2.5e-2;

#[derive(Debug, Clone, Args)]
pub struct PressScene {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Depth, mm
    #[arg(long, default_value_t = 15.0)]
    depth_mm: f64,
    /// Speed, mm/s
    #[arg(long, default_value_t = 100.0)]
    speed_mm_s: f64,
    /// Time budget of a tick until its last iteration begins, ms
    #[arg(long, default_value_t = 1.0)]
    budget_ms: f64,
    /// Tolerance of the converged solutions: 1e-3 leaves 0.2 % of the force, and takes minutes on half a
    /// million nodes
    #[arg(long, default_value_t = 1e-5)]
    converged: f64,
    /// Number of presses, each from rest
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=1000))]
    repeats: u16,
    /// Cut through the tissue first, and press beside the wound
    #[arg(long)]
    wound: bool,
    /// Threads
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
}

impl Benchmark for PressScene {
    type Report = PressSceneReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<PressSceneReport, String> {
        for (name, value) in [
            ("--depth-mm", self.depth_mm),
            ("--speed-mm-s", self.speed_mm_s),
            ("--budget-ms", self.budget_ms),
        ] {
            if !(value > 0.0 && value <= 1e4) {
                return Err(format!("{name} {value} must be above 0 and at most 10000"));
            }
        }
        let converged = self.converged;
        if !(1e-8..=1e-2).contains(&converged) {
            return Err(format!("--converged {converged} must be from 1e-8 to 0.01"));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        on_threads(usize::from(self.threads), || self.run(model, progress))?
    }
}

#[derive(Debug, Clone, Default, Serialize)]
pub struct Tick {
    pub press: usize,
    pub draws_back: bool,
    #[serde(skip)]
    tool: usize,
    pub depth_mm: f64,
    /// Force along the normal, N.
    pub force_n: f64,
    pub converged_n: f64,
    pub error: f64,
    pub ms: f64,
    pub iterations: usize,
    pub active: usize,
    pub converged_residual: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct Figures {
    /// Median and 99th percentile of the tick duration, ms.
    pub ms: [f64; 2],
    pub worst_error: f64,
    pub rms_error: f64,
    /// The same errors relative to the largest converged force: relative to their own, forces of some mN count most.
    pub worst_error_of_largest: f64,
    pub rms_error_of_largest: f64,
}

impl Figures {
    fn of(ticks: &[&Tick], largest_n: f64) -> Self {
        let times: Vec<f64> = ticks.iter().map(|t| t.ms).collect();
        let worst = |errors: &[f64]| errors.iter().fold(0.0, |most: f64, e| most.max(e.abs()));
        let rms = |errors: &[f64]| {
            let squares: f64 = errors.iter().map(|e| e * e).sum();
            (squares / errors.len() as f64).sqrt()
        };
        let own: Vec<f64> = ticks.iter().map(|t| t.error).collect();
        let of_largest = |t: &&Tick| (t.force_n - t.converged_n) / largest_n;
        let of_largest: Vec<f64> = ticks.iter().map(of_largest).collect();
        Self {
            ms: [super::median(&times), super::quantile(&times, 0.99)],
            worst_error: worst(&own),
            rms_error: rms(&own),
            worst_error_of_largest: worst(&of_largest),
            rms_error_of_largest: rms(&of_largest),
        }
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "tick p50 {:.2} ms, p99 {:.2} ms; force error worst {:.1} %, rms {:.1} %; of the largest force worst {:.1} %, \
             rms {:.2} %",
            self.ms[0],
            self.ms[1],
            self.worst_error * 100.0,
            self.rms_error * 100.0,
            self.worst_error_of_largest * 100.0,
            self.rms_error_of_largest * 100.0
        )
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct PressSceneReport {
    pub wound: Option<Wound>,
    pub nodes: usize,
    pub setup_ms: f64,
    /// Figures of pressing and of rest at depth.
    #[serde(flatten)]
    pub press: Figures,
    pub back: Figures,
    pub active: usize,
    /// Slope of the converged force over the last fifth of the depth, divided by that of the first fifth.
    pub stiffening: f64,
    pub ticks: Vec<Tick>,
}

struct Prepared {
    location: ToolLocation,
    first: Tissue,
    setup_ms: f64,
    wound: Option<Wound>,
    tools: Vec<Tool>,
    /// Number of tool poses on the way down.
    moving: usize,
    ticks: Vec<Tick>,
}

impl PressScene {
    fn run(
        &self,
        model: Arc<Model>,
        progress: &mut OnStage<'_>,
    ) -> Result<PressSceneReport, String> {
        progress("preparing the model");
        let mut model = self.prepare(model)?;
        // Presses first, so that the caches hold only what a session uses.
        for repeat in 1..=usize::from(self.repeats) {
            progress(&format!("press {repeat} of {}", self.repeats));
            self.press(&mut model, repeat);
        }
        self.converge(&mut model, progress);
        Ok(summary(model))
    }

    fn prepare(&self, model: Arc<Model>) -> Result<Prepared, String> {
        let mut topology = Topology::new(model);
        let mut location = ToolLocation::find(&topology)?;
        let wound = if self.wound {
            Some(Wound::open(&mut topology, &mut location)?.0)
        } else {
            None
        };
        let began = Instant::now();
        let first = Tissue::at_rest(topology);
        let setup_ms = began.elapsed().as_secs_f64() * 1e3;
        location.sag(&first);
        let (depth_m, step_m) = (self.depth_mm * 1e-3, self.speed_mm_s * 1e-3 * TICK_S);
        let moving = (depth_m / step_m).ceil() as usize;
        let tools = (1..=moving + REST)
            .map(|k| {
                let depth = (k as f64 * step_m).min(depth_m);
                Tool::ball(
                    1,
                    location.middle + location.normal * (RADIUS_M - depth),
                    RADIUS_M,
                )
            })
            .collect();
        Ok(Prepared {
            location,
            first,
            setup_ms,
            wound,
            tools,
            moving,
            ticks: Vec::new(),
        })
    }

    fn press(&self, model: &mut Prepared, repeat: usize) {
        let location = &model.location;
        let mut hand = model.first.another();
        let out = (0..model.moving.saturating_sub(1)).rev();
        let ways = (0..model.tools.len()).map(|t| (t, false));
        for (number, draws_back) in ways.chain(out.map(|t| (t, true))) {
            let tool = &model.tools[number];
            let began = Instant::now();
            let ms = || began.elapsed().as_secs_f64() * 1e3;
            let mut stop = || ms() > self.budget_ms;
            let budget = Budget {
                near: true,
                stop: Some(&mut stop),
                ..Budget::new(10, TOLERANCE)
            };
            let report = hand.step(&[*tool], budget);
            model.ticks.push(Tick {
                press: repeat,
                draws_back,
                tool: number,
                depth_mm: (RADIUS_M - (tool.centre - location.middle).dot(&location.normal)) * 1e3,
                force_n: felt(report, tool, location),
                ms: ms(),
                iterations: report.iterations,
                active: report.active_nodes,
                ..Tick::default()
            });
        }
    }

    fn converge(&self, model: &mut Prepared, progress: &mut OnStage<'_>) {
        let count = model.tools.len();
        let mut exact = model.first.another();
        for (k, tool) in model.tools.iter().enumerate() {
            progress(&format!("converging tick {} of {count}", k + 1));
            let budget = Budget::new(200, self.converged);
            let report = exact.step(&[*tool], budget);
            for tick in model.ticks.iter_mut().filter(|t| t.tool == k) {
                tick.converged_n = felt(report, tool, &model.location);
                tick.error = (tick.force_n - tick.converged_n) / tick.converged_n.max(LEAST_N);
                tick.converged_residual = report.residual;
            }
        }
    }
}

/// The force along the location's normal that the force loop renders at the pose of the tool: that at the proxy, continued
/// linearly.
fn felt(report: &StepReport, tool: &Tool, location: &ToolLocation) -> f64 {
    let reaction = &report.reactions[0];
    let felt = reaction.force - reaction.stiffness * (tool.centre - reaction.at);
    felt.dot(&location.normal).max(0.0)
}

fn summary(model: Prepared) -> PressSceneReport {
    let ticks = model.ticks;
    let moving = &ticks[..model.moving.min(ticks.len())];
    let (back, press): (Vec<&Tick>, Vec<&Tick>) = ticks.iter().partition(|t| t.draws_back);
    let largest = ticks.iter().map(|t| t.converged_n).fold(LEAST_N, f64::max);
    let slope = |part: &[Tick]| match part {
        [first, .., last] => {
            (last.converged_n - first.converged_n) / (last.depth_mm - first.depth_mm)
        }
        _ => f64::NAN,
    };
    let fifth = (moving.len() / 5).max(2).min(moving.len());
    PressSceneReport {
        wound: model.wound,
        nodes: model.first.topology().node_count(),
        setup_ms: model.setup_ms,
        press: Figures::of(&press, largest),
        back: Figures::of(&back, largest),
        active: ticks.iter().map(|t| t.active).max().unwrap_or(0),
        stiffening: slope(&moving[moving.len() - fifth..]) / slope(&moving[..fifth]),
        ticks,
    }
}

impl fmt::Display for PressSceneReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:>8} {:>9} {:>9} {:>7} {:>7} {:>5} {:>7}",
            "depth mm", "force N", "conv. N", "error", "ms", "iter", "active"
        )?;
        for t in self.ticks.iter().filter(|t| t.press == 1) {
            writeln!(
                f,
                "{:>8.1} {:>9.4} {:>9.4} {:>6.1}% {:>7.2} {:>5} {:>7}",
                t.depth_mm,
                t.force_n,
                t.converged_n,
                t.error * 100.0,
                t.ms,
                t.iterations,
                t.active
            )?;
        }
        if let Some(wound) = &self.wound {
            writeln!(
                f,
                "beside a wound of {:.0} mm through {} ({} nodes doubled)",
                wound.depth_mm,
                wound.regions.join(", "),
                wound.doubled
            )?;
        }
        write!(
            f,
            "{} nodes; at most {} active; slope of the last fifth {:.1} times the first\n\
             press: {}\n\
             withdrawal: {}",
            self.nodes, self.active, self.stiffening, self.press, self.back
        )
    }
}
