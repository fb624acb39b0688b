//! A tool led along a path: the rendered force and the converged force.
//!
//! The haptic path is that of the client: a [`Replica`] solved at 250 Hz with the budget of a hand, and the 1
//! kHz [`Chain`] between solves. The device follows the path whatever force it renders. Time is virtual; a
//! model becomes available after the processor time of its solve on one thread. A machine that is too slow
//! therefore shows in the result, and one with other load does not.
//!
//! The reference is a second solver that converges every [`CHECK_MS`] milliseconds along the path, at every
//! phase of the haptic period. Its friction is that of a sliding tool: at each active contact point μd times
//! the normal force, against the motion (Coulomb).

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use palpate_client::realtime::{Horizon, worked};
use palpate_device::script::{Hand, Script, ScriptPose, Tool as ScriptTool, Waypoint};
use palpate_device::{DeviceCaps, DeviceTime, Sample, Workspace, Wrench};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Events};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ClientTime, ParticipantId, Span};
use palpate_site::{HAPTIC_PERIOD, Replica, ToolAt, hand_budget};
use palpate_tissue::{Budget, Model, Reaction, Tissue, Tool};
use serde::Serialize;

use crate::experiments::Table;

const TICK: Span = Span::from_millis(1);
/// Period of the converged solves, ms; coprime to the haptic period.
pub const CHECK_MS: i64 = 11;
/// Rest before the path begins: longer than the soft start of the chain.
const LEAD: Span = Span::from_millis(1200);
/// Relative residual of a converged solve. 1e-3 leaves 0.2 % of the force; 1e-4 takes a second per position on
/// the thigh.
const CONVERGED: f64 = 5e-4;
const ITERATIONS: usize = 60;
/// Sliding threshold, m/s.
const SLIDES_M_S: f64 = 5e-3;
/// Ticks for which the tool must have slid.
const SLID_TICKS: usize = 20;

#[derive(Debug, Clone)]
pub struct Scenario {
    pub model: Arc<Model>,
    pub tool: ToolDescription,
    pub path: Script,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    pub t_s: f64,
    pub position: Vector3<f64>,
    pub rendered: Wrench,
    /// Whether the tool has slid for `SLID_TICKS` ticks.
    pub slides: bool,
    pub solution: Option<Solution>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    pub frictionless: Wrench,
    /// Friction wrench if the tool slides.
    pub friction: Wrench,
    /// Sum of the normal forces, N.
    pub pressed_n: f64,
    pub residual: f64,
}

impl Solution {
    /// The wrench with friction if the tool slides, without it otherwise.
    pub fn at(&self, slides: bool) -> Wrench {
        let share = f64::from(u8::from(slides));
        Wrench {
            force: self.frictionless.force + self.friction.force * share,
            torque: self.frictionless.torque + self.friction.torque * share,
        }
    }
}

#[derive(Debug, Clone)]
pub struct ScenarioResult {
    pub points: Vec<Point>,
    pub counters: Counters,
    /// Processor time of the solves, ms: median and 99th percentile.
    pub solve_ms: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Deviation {
    /// Rms of the difference over the rms of the converged value.
    pub rms: f64,
    /// Largest difference over the largest converged value.
    pub worst: f64,
    /// Largest converged value, N or N·m.
    pub largest: f64,
    /// Number of compared points; if zero, the shares are NaN.
    pub n: usize,
}

impl Deviation {
    pub fn of(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) -> Self {
        let (mut off, mut all, mut worst, mut largest, mut n) = (0.0, 0.0, 0.0_f64, 0.0_f64, 0);
        for (rendered, solution) in pairs {
            let apart = (rendered - solution).norm();
            off += apart * apart;
            all += solution.norm_squared();
            worst = worst.max(apart);
            largest = largest.max(solution.norm());
            n += 1;
        }
        let share = |a: f64, b: f64| if b > 0.0 { a / b } else { f64::NAN };
        Self {
            rms: share(off, all).sqrt(),
            worst: share(worst, largest),
            largest,
            n,
        }
    }
}

/// A device without limits, which follows the path exactly.
fn caps() -> DeviceCaps {
    let half = Vector3::repeat(10.0);
    DeviceCaps {
        name: "led".to_owned(),
        dof_in: 6,
        dof_out: 6,
        workspace: Workspace {
            min: -half,
            max: half,
        },
        max_force_n: 50.0,
        continuous_force_n: 50.0,
        max_torque_nm: 5.0,
        max_stiffness_n_per_m: 1e4,
        rate_hz: 1000.0,
    }
}

impl Scenario {
    /// A tool on a path of way points, without the dynamics of a simulated hand.
    pub fn new(
        model: Arc<Model>,
        tool: ToolDescription,
        path: Vec<Waypoint>,
    ) -> Result<Self, String> {
        let path = Script::new(ScriptTool::probe(1e-3), Hand::default(), path, false);
        Ok(Self {
            model,
            tool,
            path: path.map_err(|e| e.to_string())?,
        })
    }

    pub fn run(&self, progress: &mut (dyn FnMut(f64) + Send)) -> ScenarioResult {
        let (mut points, counters, solve_ms) = self.render(&mut |done| progress(0.5 * done));
        // The converged solves may use all cores.
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        let mut converge = || self.converge(&mut points, &mut |done| progress(0.5 + 0.5 * done));
        if crate::bench::on_threads(all, &mut converge).is_err() {
            converge();
        }
        ScenarioResult {
            points,
            counters,
            solve_ms,
        }
    }

    fn ticks(&self) -> i64 {
        (self.path.end_s() * 1e3).round() as i64
    }

    fn at(&self, at: &ScriptPose) -> ToolAt {
        ToolAt {
            participant: ParticipantId(1),
            description: self.tool,
            position: at.pose.position,
            orientation: at.pose.orientation,
            buttons: u8::from(at.button),
            strength: 1.0,
            returns: false,
            predicted: None,
        }
    }

    fn render(&self, progress: &mut dyn FnMut(f64)) -> (Vec<Point>, Counters, [f64; 2]) {
        let mut replica = Replica::new(Arc::clone(&self.model), true);
        let mut chain = Chain::new(ChainConfig::default(), &caps());
        let mut horizon = Horizon::default();
        let (mut known, mut coming) = (ContactModel::FREE, None::<(ClientTime, ContactModel)>);
        let (mut solve_at, mut times, mut slid) = (ClientTime::ZERO, Vec::new(), 0);
        let mut points = Vec::new();
        let lead = LEAD.as_micros() / TICK.as_micros();
        for tick in -lead..=self.ticks() {
            let now = ClientTime::ZERO + LEAD + Span::from_micros(tick * TICK.as_micros());
            let at = self.path.pose(tick as f64 * 1e-3);
            let sample = Sample {
                velocity: at.velocity,
                angular_velocity: at.angular_velocity,
                ..Sample::resting(DeviceTime::from_micros(now.as_micros()), at.pose)
            };
            if let Some((_, model)) = coming.take_if(|(ready, _)| *ready <= now) {
                known = model;
            }
            if coming.is_none() && now >= solve_at {
                let began = worked();
                let mut stop = || worked() - began > HAPTIC_PERIOD;
                let budget = hand_budget(&mut stop);
                let predicted = Some(horizon.predicted_pose(&sample));
                let tool = ToolAt {
                    predicted,
                    ..self.at(&at)
                };
                let model = replica.haptic_step(now, Some(&tool), &[], budget);
                let took = worked() - began;
                horizon.note_model(now, now + took);
                coming = Some((now + took, model));
                solve_at = (now + HAPTIC_PERIOD).max(now + took);
                if tick >= 0 {
                    times.push(took.as_secs_f64() * 1e3);
                }
            }
            let done = chain.tick(now, &sample, &known);
            let slides = done.events.contains(Events::SLIP) && !done.events.contains(Events::STICK);
            slid = if slides { slid + 1 } else { 0 };
            if tick >= 0 {
                points.push(Point {
                    t_s: tick as f64 * 1e-3,
                    position: at.pose.position,
                    rendered: done.wrench,
                    slides: slid > SLID_TICKS,
                    solution: None,
                });
                progress(tick as f64 / self.ticks().max(1) as f64);
            }
        }
        let quantile = |q| crate::bench::quantile(&times, q);
        (points, *chain.counters(), [quantile(0.5), quantile(0.99)])
    }

    fn converge(&self, points: &mut [Point], progress: &mut dyn FnMut(f64)) {
        let mut tissue = Tissue::new(Arc::clone(&self.model));
        let count = points.len();
        for (k, point) in points.iter_mut().enumerate().step_by(CHECK_MS as usize) {
            let at = self.path.pose(point.t_s);
            let tools: Vec<Tool> = self.at(&at).contacts().collect();
            let budget = Budget::new(ITERATIONS, CONVERGED);
            let report = tissue.step(&tools, budget);
            point.solution = Some(solution(&report.reactions, &at, report.residual));
            progress(k as f64 / count as f64);
        }
    }
}

/// Converged wrench about the pivot, from the reactions of a moving tool.
fn solution(reactions: &[Reaction], at: &ScriptPose, residual: f64) -> Solution {
    let mut solution = Solution {
        frictionless: Wrench::ZERO,
        friction: Wrench::ZERO,
        pressed_n: 0.0,
        residual,
    };
    for reaction in reactions {
        solution.frictionless.force += reaction.force;
        solution.frictionless.torque += reaction.torque;
        for contact in &reaction.contact_patches {
            solution.pressed_n += contact.pressed;
            let v = at.velocity + at.angular_velocity.cross(&contact.lever);
            let across = v - contact.normal * contact.normal.dot(&v);
            if across.norm() > SLIDES_M_S {
                let force = across.normalize() * (-contact.friction_dynamic * contact.pressed);
                solution.friction.force += force;
                solution.friction.torque += contact.lever.cross(&force);
            }
        }
    }
    solution
}

impl ScenarioResult {
    pub fn checked(&self) -> impl Iterator<Item = (&Point, Solution)> {
        self.points.iter().filter_map(|p| Some((p, p.solution?)))
    }

    /// Rendered against converged force without friction, for frictionless tissue.
    pub fn frictionless(&self) -> Deviation {
        let pairs = self.checked();
        Deviation::of(pairs.map(|(p, t)| (p.rendered.force, t.frictionless.force)))
    }

    pub fn frictionless_torque(&self) -> Deviation {
        let pairs = self.checked();
        Deviation::of(pairs.map(|(p, t)| (p.rendered.torque, t.frictionless.torque)))
    }

    /// Force with friction while the tool slides.
    pub fn sliding(&self) -> Deviation {
        let slides = self.checked().filter(|(p, _)| p.slides);
        Deviation::of(slides.map(|(p, t)| (p.rendered.force, t.at(true).force)))
    }

    pub fn sliding_torque(&self) -> Deviation {
        let slides = self.checked().filter(|(p, _)| p.slides);
        Deviation::of(slides.map(|(p, t)| (p.rendered.torque, t.at(true).torque)))
    }

    pub fn slid(&self, from_s: f64) -> f64 {
        let all = || self.checked().filter(|(p, _)| p.t_s >= from_s);
        all().filter(|(p, _)| p.slides).count() as f64 / all().count() as f64
    }

    /// Largest residual, and the number of checks above the requested one.
    pub fn residuals(&self) -> serde_json::Value {
        let worst = self.checked().map(|(_, t)| t.residual).fold(0.0, f64::max);
        let over = self
            .checked()
            .filter(|(_, t)| t.residual > CONVERGED)
            .count();
        serde_json::json!({ "worst": worst, "over": over, "checks": self.checked().count() })
    }

    pub fn table(&self) -> Table {
        let mut table = Table::new(
            "t_s,x_mm,y_mm,z_mm,fx_n,fy_n,fz_n,tx_nmm,ty_nmm,tz_nmm,slides,converged_fx_n,converged_fy_n,\
             converged_fz_n,converged_tx_nmm,converged_ty_nmm,converged_tz_nmm,pressed_n,residual",
        );
        let numbers = |v: Vector3<f64>, digits: usize| v.map(|x| format!("{x:.digits$}"));
        for p in &self.points {
            let mut row = vec![format!("{:.3}", p.t_s)];
            row.extend(numbers(p.position * 1e3, 4).iter().cloned());
            row.extend(numbers(p.rendered.force, 5).iter().cloned());
            row.extend(numbers(p.rendered.torque * 1e3, 4).iter().cloned());
            row.push(u8::from(p.slides).to_string());
            if let Some(solution) = p.solution {
                let all = solution.at(p.slides);
                row.extend(numbers(all.force, 5).iter().cloned());
                row.extend(numbers(all.torque * 1e3, 4).iter().cloned());
                row.push(format!("{:.5}", solution.pressed_n));
                row.push(format!("{:.1e}", solution.residual));
            }
            row.resize(table.head.len(), String::new());
            table.rows.push(row);
        }
        table
    }
}

/// A rotation of z to `normal`: the tool handle points out of the tissue.
pub fn upright(normal: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vector3::z(), normal).unwrap_or_else(|| {
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
    })
}
