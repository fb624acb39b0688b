//! `bench press-scene`: a sphere pressed into any model at the speed of a hand.
//!
//! A sphere of 8 mm radius goes 15 mm deep at 100 mm/s where the model has room for it, solved 250
//! times a second with the budget of a hand, several times from rest, and draws back as fast. Afterwards another
//! solver converges at every place of the tool, and the forces are compared.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use palpate_tissue::{Budget, Model, Shape, Solver, StepReport, Tool, Topology};
use serde::Serialize;

use super::wound::Wound;
use crate::place::Place;

/// Radius of the sphere in m.
const RADIUS_M: f64 = 8e-3;
/// Time between two ticks in s.
const TICK_S: f64 = 4e-3;
/// Ticks at rest at the end.
const REST: usize = 5;
/// Force below which a relative error says nothing, in N.
const LEAST_N: f64 = 2e-3;

/// What is to be measured.
#[derive(Debug, Clone, Copy)]
pub struct PressScene {
    /// How deep in m.
    pub depth_m: f64,
    /// How fast in m/s.
    pub speed_m_s: f64,
    /// Time a tick may take before its last iteration begins, in ms.
    pub budget_ms: f64,
    /// Tolerance of a tick.
    pub tolerance: f64,
    /// Tolerance of what it is compared with.
    pub converged: f64,
    /// How many times the press is made, each from rest.
    pub repeats: usize,
    /// Whether to press beside a fresh wound.
    pub wound: bool,
}

impl Default for PressScene {
    fn default() -> Self {
        Self {
            depth_m: 15e-3,
            speed_m_s: 0.1,
            budget_ms: 1.0,
            tolerance: 2.5e-2,
            converged: 1e-5,
            repeats: 5,
            wound: false,
        }
    }
}

/// One tick.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Tick {
    /// Which of the presses it belongs to, from 1.
    pub press: usize,
    /// Whether the tool draws back.
    pub draws_back: bool,
    /// Which of the tools of a press it is.
    #[serde(skip)]
    tool: usize,
    /// Depth in mm.
    pub depth_mm: f64,
    /// Force along the normal in N.
    pub force_n: f64,
    /// The converged one.
    pub converged_n: f64,
    /// Their difference in parts of the converged one.
    pub error: f64,
    /// What it took.
    pub ms: f64,
    /// Iterations it had time for.
    pub iterations: usize,
    /// Nodes that took part.
    pub active: usize,
    /// Residual of the converged one.
    pub converged_residual: f64,
}

/// Figures of some ticks.
#[derive(Debug, Clone, Serialize)]
pub struct Figures {
    /// Median and 99th percentile of a tick, ms.
    pub ms: [f64; 2],
    /// Largest relative force error.
    pub worst_error: f64,
    /// Root of the mean square of it.
    pub rms_error: f64,
}

impl Figures {
    fn of(ticks: &[&Tick]) -> Self {
        let times: Vec<f64> = ticks.iter().map(|t| t.ms).collect();
        let squares: f64 = ticks.iter().map(|t| t.error * t.error).sum();
        Self {
            ms: [super::median(&times), super::quantile(&times, 0.99)],
            worst_error: ticks.iter().map(|t| t.error.abs()).fold(0.0, f64::max),
            rms_error: (squares / ticks.len() as f64).sqrt(),
        }
    }
}

/// Figures of a run.
#[derive(Debug, Clone, Serialize)]
pub struct PressSceneReport {
    /// The wound it was pressed beside.
    pub wound: Option<Wound>,
    /// Nodes of the model.
    pub nodes: usize,
    /// Bricks and coarse lattices, once, ms.
    pub setup_ms: f64,
    /// Of ticks of pressing, and of being there.
    #[serde(flatten)]
    pub press: Figures,
    /// Of ticks of drawing back.
    pub back: Figures,
    /// Most nodes that took part.
    pub active: usize,
    /// Slope of the converged force over the last fifth of the depth over that of the first.
    pub stiffening: f64,
    /// All ticks.
    pub ticks: Vec<Tick>,
}

/// A model with its tools, ready to be pressed.
struct Prepared {
    topology: Topology,
    place: Place,
    first: Solver,
    setup_ms: f64,
    wound: Option<Wound>,
    tools: Vec<Tool>,
    /// How many of the tools are on their way down.
    moving: usize,
    ticks: Vec<Tick>,
}

impl PressScene {
    /// Runs it; one report per model. Presses of several models take turns, so that their times can be compared
    /// on a machine with better and worse minutes.
    ///
    /// # Errors
    ///
    /// When there is no place for a sphere on a model.
    pub fn run(
        &self,
        models: Vec<Arc<Model>>,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Vec<PressSceneReport>, String> {
        progress("preparing the model");
        let prepared: Result<Vec<Prepared>, String> =
            models.into_iter().map(|m| self.prepare(m)).collect();
        let mut prepared = prepared?;
        // Presses first: between two ticks of a hand nothing else has to be in the caches.
        for repeat in 1..=self.repeats {
            progress(&format!("press {repeat} of {}", self.repeats));
            for model in &mut prepared {
                self.press(model, repeat);
            }
        }
        for model in &mut prepared {
            self.converge(model, progress);
        }
        Ok(prepared.into_iter().map(summary).collect())
    }

    fn prepare(&self, model: Arc<Model>) -> Result<Prepared, String> {
        let mut topology = Topology::new(model);
        let mut place = Place::find(&topology).map_err(|e| e.to_string())?;
        let wound = if self.wound {
            Some(Wound::open(&mut topology, &mut place)?)
        } else {
            None
        };
        let began = Instant::now();
        let first = Solver::new(&topology);
        let setup_ms = began.elapsed().as_secs_f64() * 1e3;
        place.sag(&topology, &first);
        let moving = (self.depth_m / (self.speed_m_s * TICK_S)).ceil() as usize;
        let tools = (1..=moving + REST)
            .map(|k| {
                let depth = (k as f64 * self.speed_m_s * TICK_S).min(self.depth_m);
                Tool::ball(
                    1,
                    place.middle + place.normal * (RADIUS_M - depth),
                    RADIUS_M,
                )
            })
            .collect();
        Ok(Prepared {
            topology,
            place,
            first,
            setup_ms,
            wound,
            tools,
            moving,
            ticks: Vec::new(),
        })
    }

    /// One press from rest and back.
    fn press(&self, model: &mut Prepared, repeat: usize) {
        let (topology, place) = (&model.topology, &model.place);
        let (mut hand, mut shape) = (model.first.another(topology), Shape::rest(topology));
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
                ..Budget::new(10, self.tolerance)
            };
            let report = hand.step(topology, &mut shape, &[*tool], budget);
            model.ticks.push(Tick {
                press: repeat,
                draws_back,
                tool: number,
                depth_mm: (RADIUS_M - (tool.centre - place.middle).dot(&place.normal)) * 1e3,
                force_n: along(report, place),
                ms: ms(),
                iterations: report.iterations,
                active: report.active_nodes,
                ..Tick::default()
            });
        }
    }

    /// Another solver converges at every place of the tool.
    fn converge(&self, model: &mut Prepared, progress: &mut dyn FnMut(&str)) {
        let (topology, count) = (&model.topology, model.tools.len());
        let (mut exact, mut shape) = (model.first.another(topology), Shape::rest(topology));
        for (k, tool) in model.tools.iter().enumerate() {
            progress(&format!("converging tick {} of {count}", k + 1));
            let budget = Budget::new(200, self.converged);
            let report = exact.step(topology, &mut shape, &[*tool], budget);
            for tick in model.ticks.iter_mut().filter(|t| t.tool == k) {
                tick.converged_n = along(report, &model.place);
                tick.error = (tick.force_n - tick.converged_n) / tick.converged_n.max(LEAST_N);
                tick.converged_residual = report.residual;
            }
        }
    }
}

fn along(report: &StepReport, place: &Place) -> f64 {
    report.reactions[0].force.dot(&place.normal)
}

fn summary(model: Prepared) -> PressSceneReport {
    let ticks = model.ticks;
    let moving = &ticks[..model.moving.min(ticks.len())];
    let (back, press): (Vec<&Tick>, Vec<&Tick>) = ticks.iter().partition(|t| t.draws_back);
    let slope = |part: &[Tick]| match part {
        [first, .., last] => {
            (last.converged_n - first.converged_n) / (last.depth_mm - first.depth_mm)
        }
        _ => f64::NAN,
    };
    let fifth = (moving.len() / 5).max(2).min(moving.len());
    PressSceneReport {
        wound: model.wound,
        nodes: model.topology.node_count(),
        setup_ms: model.setup_ms,
        press: Figures::of(&press),
        back: Figures::of(&back),
        active: ticks.iter().map(|t| t.active).max().unwrap_or(0),
        stiffening: slope(&moving[moving.len() - fifth..]) / slope(&moving[..fifth]),
        ticks,
    }
}

/// Two models that were pressed in turns.
#[derive(Debug, Clone, Serialize)]
pub struct Comparison {
    /// The one that was asked for.
    #[serde(flatten)]
    pub report: PressSceneReport,
    /// What it is compared with.
    pub against: PressSceneReport,
    /// Times of the first over those of the second: median and 99th percentile.
    pub ratio: [f64; 2],
}

impl Comparison {
    /// Compares.
    pub fn of(report: PressSceneReport, against: PressSceneReport) -> Self {
        let ratio = [0, 1].map(|q| report.press.ms[q] / against.press.ms[q]);
        Self {
            report,
            against,
            ratio,
        }
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p99] = self.ratio;
        writeln!(f, "{}", self.report)?;
        writeln!(f, "against {}", self.against.figures())?;
        write!(
            f,
            "a tick takes {p50:.2} times as long (p50), {p99:.2} times (p99)"
        )
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
        f.write_str(&self.figures())
    }
}

impl PressSceneReport {
    /// All but the ticks, in a line.
    fn figures(&self) -> String {
        format!(
            "{} nodes; tick p50 {:.2} ms, p99 {:.2} ms; force error worst {:.1} %, rms {:.1} %; at \
             most {} nodes active; slope of the last fifth {:.1} times the first; drawn back p50 {:.2} ms, \
             p99 {:.2} ms, worst {:.1} %, rms {:.1} %",
            self.nodes,
            self.press.ms[0],
            self.press.ms[1],
            self.press.worst_error * 100.0,
            self.press.rms_error * 100.0,
            self.active,
            self.stiffening,
            self.back.ms[0],
            self.back.ms[1],
            self.back.worst_error * 100.0,
            self.back.rms_error * 100.0
        )
    }
}
