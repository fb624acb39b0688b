//! A tool led along a path: what the hand feels of it, and what is true.
//!
//! The haptic path is the real one: a [`Replica`] solved 250 times a second with the budget of a hand, and the 1 kHz
//! [`Chain`] between its answers, on a device that follows the path whatever it is given. Time is virtual but for one thing:
//! a model is there for the chain when the processor time has passed that its solve took on one thread, so a
//! machine that is too slow shows, and one that is busy with others does not.
//!
//! The truth is another solver that converges at a place of the path every [`CHECK_MS`] milliseconds, in every phase of
//! the haptic path's period. Of friction it knows what a tool that slides is held back by: at each place that touches,
//! μd times what presses there, against the motion (Coulomb).

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use palpate_client::Replica;
use palpate_client::realtime::worked;
use palpate_client::replica::{HAPTIC_PERIOD, hand_budget};
use palpate_client::roster::ToolAt;
use palpate_device::script::{Hand, Script, ScriptPose, Tool as ScriptTool, WayPoint};
use palpate_device::{DeviceCaps, DeviceTime, Sample, Workspace, Wrench};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Counters, Events};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ClientTime, ParticipantId, Span};
use palpate_tissue::{Budget, Model, Reaction, Shape, Solver, Tool, Topology};
use serde::Serialize;

/// From one tick of the chain to the next.
const TICK: Span = Span::from_millis(1);
/// From one converged answer to the next, ms. It has no part in common with the haptic path's period.
pub const CHECK_MS: i64 = 11;
/// Rest before the path begins: the soft start of the chain is over then.
const LEAD: Span = Span::from_millis(1200);
/// Residual of what counts as converged: 1e-3 leaves a fifth of a percent of the force, and a thigh would take a second
/// per place for 1e-4.
const CONVERGED: f64 = 5e-4;
/// Iterations for it at most; a table says what residual was left.
const ITERATIONS: usize = 60;
/// Slower than this a tool does not slide, m/s.
const SLIDES_M_S: f64 = 5e-3;
/// Ticks for which it must have slid.
const SLID_TICKS: usize = 20;

/// What is to be tried.
#[derive(Debug, Clone)]
pub struct Trial {
    /// The tissue.
    pub model: Arc<Model>,
    /// What is pressed into it.
    pub tool: ToolDescription,
    /// Along where.
    pub path: Script,
    /// The constants of the chain.
    pub chain: ChainConfig,
}

/// One tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Since the beginning of the path, s.
    pub t_s: f64,
    /// Where the pivot is, m.
    pub position: Vector3<f64>,
    /// What the hand is given.
    pub felt: Wrench,
    /// Whether the tool slides, and has done so for a while.
    pub slides: bool,
    /// The truth, where it was asked for.
    pub truth: Option<Truth>,
}

/// What a converged solution says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    /// On the tool without friction.
    pub plain: Wrench,
    /// What friction adds where the tool slides.
    pub friction: Wrench,
    /// What presses on all places, N.
    pub pressed_n: f64,
    /// Its residual.
    pub residual: f64,
}

impl Truth {
    /// All of it.
    pub fn sliding(&self) -> Wrench {
        Wrench {
            force: self.plain.force + self.friction.force,
            torque: self.plain.torque + self.friction.torque,
        }
    }
}

/// A trial that was made.
#[derive(Debug, Clone)]
pub struct Course {
    /// One per tick.
    pub points: Vec<Point>,
    /// What the chain counted.
    pub counters: Counters,
    /// Processor time of the solves, ms: median and 99th percentile.
    pub solve_ms: [f64; 2],
}

/// How far what was felt is from the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Deviation {
    /// Root mean square of the difference over that of the truth.
    pub rms: f64,
    /// Largest difference over the largest truth.
    pub worst: f64,
    /// Largest truth, N or N·m.
    pub largest: f64,
    /// Points that were compared. Without any the shares are none.
    pub n: usize,
}

impl Deviation {
    /// Of pairs of what was felt and what is true.
    pub fn of(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) -> Self {
        let (mut off, mut all, mut worst, mut largest, mut n) = (0.0, 0.0, 0.0_f64, 0.0_f64, 0);
        for (felt, truth) in pairs {
            let apart = (felt - truth).norm();
            off += apart * apart;
            all += truth.norm_squared();
            worst = worst.max(apart);
            largest = largest.max(truth.norm());
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

/// A device without limits of its own: it follows the path whatever it is given.
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

/// A path from its way points. The hand of a script has no part in it: the tool is led.
pub fn path(ways: Vec<WayPoint>) -> Result<Script, String> {
    Script::new(ScriptTool::probe(1e-3), Hand::default(), ways, false).map_err(|e| e.to_string())
}

impl Trial {
    /// Makes it; `progress` is told the share that is done.
    pub fn run(&self, progress: &mut (dyn FnMut(f64) + Send)) -> Course {
        let (mut points, counters, solve_ms) = self.feel(&mut |done| progress(0.5 * done));
        // The truth may take all cores.
        let all = std::thread::available_parallelism().map_or(1, usize::from);
        let mut converge = || self.converge(&mut points, &mut |done| progress(0.5 + 0.5 * done));
        if crate::bench::on_threads(all, &mut converge).is_err() {
            converge();
        }
        Course {
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
            stale: false,
        }
    }

    /// The haptic path.
    fn feel(&self, progress: &mut dyn FnMut(f64)) -> (Vec<Point>, Counters, [f64; 2]) {
        let mut replica = Replica::new(Arc::clone(&self.model), true);
        let mut chain = Chain::new(self.chain, &caps());
        let (mut known, mut coming) = (ContactModel::FREE, None::<(ClientTime, ContactModel)>);
        let (mut solve_at, mut times, mut slid) = (ClientTime::ZERO, Vec::new(), 0);
        let mut points = Vec::new();
        let lead = LEAD.as_micros() / TICK.as_micros();
        for tick in -lead..=self.ticks() {
            let now = ClientTime::ZERO + LEAD + Span::from_micros(tick * TICK.as_micros());
            let at = self.path.pose(tick as f64 * 1e-3);
            if let Some((_, model)) = coming.take_if(|(ready, _)| *ready <= now) {
                known = model;
            }
            if coming.is_none() && now >= solve_at {
                let began = worked();
                let mut stop = || worked() - began > HAPTIC_PERIOD;
                let budget = hand_budget(&mut stop);
                let model = replica.haptic_step(now, Some(&self.at(&at)), &[], budget);
                let took = worked() - began;
                coming = Some((now + took, model));
                solve_at = (now + HAPTIC_PERIOD).max(now + took);
                if tick >= 0 {
                    times.push(took.as_secs_f64() * 1e3);
                }
            }
            let sample = Sample {
                velocity: at.velocity,
                angular_velocity: at.angular_velocity,
                ..Sample::resting(DeviceTime::from_micros(now.as_micros()), at.pose)
            };
            let done = chain.tick(now, &sample, &known);
            let slides = done.events.contains(Events::SLIP) && !done.events.contains(Events::STICK);
            slid = if slides { slid + 1 } else { 0 };
            if tick >= 0 {
                points.push(Point {
                    t_s: tick as f64 * 1e-3,
                    position: at.pose.position,
                    felt: done.wrench,
                    slides: slid > SLID_TICKS,
                    truth: None,
                });
                progress(tick as f64 / self.ticks().max(1) as f64);
            }
        }
        let quantile = |q| crate::bench::quantile(&times, q);
        (points, *chain.counters(), [quantile(0.5), quantile(0.99)])
    }

    /// The truth at every place that is checked.
    fn converge(&self, points: &mut [Point], progress: &mut dyn FnMut(f64)) {
        let topology = Topology::new(Arc::clone(&self.model));
        let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
        let count = points.len();
        for (k, point) in points.iter_mut().enumerate().step_by(CHECK_MS as usize) {
            let at = self.path.pose(point.t_s);
            let tools: Vec<Tool> = self.at(&at).contacts().collect();
            let budget = Budget::new(ITERATIONS, CONVERGED);
            let report = solver.step(&topology, &mut shape, &tools, budget);
            point.truth = Some(truth(&report.reactions, &at, report.residual));
            progress(k as f64 / count as f64);
        }
    }
}

/// What these reactions say about the pivot of a tool that moves so.
fn truth(reactions: &[Reaction], at: &ScriptPose, residual: f64) -> Truth {
    let mut truth = Truth {
        plain: Wrench::ZERO,
        friction: Wrench::ZERO,
        pressed_n: 0.0,
        residual,
    };
    for reaction in reactions {
        truth.plain.force += reaction.force;
        truth.plain.torque += reaction.torque;
        for place in &reaction.places {
            truth.pressed_n += place.pressed;
            let v = at.velocity + at.angular_velocity.cross(&place.lever);
            let across = v - place.normal * place.normal.dot(&v);
            if across.norm() > SLIDES_M_S {
                let force = across.normalize() * (-place.friction_dynamic * place.pressed);
                truth.friction.force += force;
                truth.friction.torque += place.lever.cross(&force);
            }
        }
    }
    truth
}

impl Course {
    /// The points with a truth.
    pub fn checked(&self) -> impl Iterator<Item = (&Point, Truth)> {
        self.points.iter().filter_map(|p| Some((p, p.truth?)))
    }

    /// Force felt against the converged one, friction left out on both sides: for tissue without any.
    pub fn plain(&self) -> Deviation {
        Deviation::of(self.checked().map(|(p, t)| (p.felt.force, t.plain.force)))
    }

    /// The same for torques about the pivot.
    pub fn plain_torque(&self) -> Deviation {
        Deviation::of(self.checked().map(|(p, t)| (p.felt.torque, t.plain.torque)))
    }

    /// Force while the tool slides, friction and all.
    pub fn sliding(&self) -> Deviation {
        let slides = self.checked().filter(|(p, _)| p.slides);
        Deviation::of(slides.map(|(p, t)| (p.felt.force, t.sliding().force)))
    }

    /// The same for torques.
    pub fn sliding_torque(&self) -> Deviation {
        let slides = self.checked().filter(|(p, _)| p.slides);
        Deviation::of(slides.map(|(p, t)| (p.felt.torque, t.sliding().torque)))
    }

    /// Of the checks from `from_s` on, the share at which the tool slid.
    pub fn slid(&self, from_s: f64) -> f64 {
        let all = || self.checked().filter(|(p, _)| p.t_s >= from_s);
        all().filter(|(p, _)| p.slides).count() as f64 / all().count() as f64
    }

    /// The worst residual of what counts as converged, and at how many checks it was more than asked for.
    pub fn residuals(&self) -> serde_json::Value {
        let worst = self.checked().map(|(_, t)| t.residual).fold(0.0, f64::max);
        let over = self
            .checked()
            .filter(|(_, t)| t.residual > CONVERGED)
            .count();
        serde_json::json!({ "worst": worst, "over": over, "checks": self.checked().count() })
    }

    /// The course as a table.
    pub fn csv(&self) -> String {
        use std::fmt::Write as _;
        let mut csv = String::from(
            "t_s,x_mm,y_mm,z_mm,fx_n,fy_n,fz_n,tx_nmm,ty_nmm,tz_nmm,slides,converged_fx_n,converged_fy_n,\
             converged_fz_n,converged_tx_nmm,converged_ty_nmm,converged_tz_nmm,pressed_n,residual\n",
        );
        for p in &self.points {
            let (x, f, t) = (p.position * 1e3, p.felt.force, p.felt.torque * 1e3);
            // Writing to a string can not fail.
            let _ = write!(
                csv,
                "{:.3},{:.4},{:.4},{:.4},{:.5},{:.5},{:.5},{:.4},{:.4},{:.4},{}",
                p.t_s,
                x.x,
                x.y,
                x.z,
                f.x,
                f.y,
                f.z,
                t.x,
                t.y,
                t.z,
                u8::from(p.slides)
            );
            match p.truth {
                Some(truth) => {
                    let all = if p.slides {
                        truth.sliding()
                    } else {
                        truth.plain
                    };
                    let (f, t) = (all.force, all.torque * 1e3);
                    let _ = writeln!(
                        csv,
                        ",{:.5},{:.5},{:.5},{:.4},{:.4},{:.4},{:.5},{:.1e}",
                        f.x, f.y, f.z, t.x, t.y, t.z, truth.pressed_n, truth.residual
                    );
                }
                None => csv.push_str(",,,,,,,,\n"),
            }
        }
        csv
    }
}

/// A turn that takes z to `normal`: how a tool's handle points away from tissue.
pub fn upright(normal: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vector3::z(), normal).unwrap_or_else(|| {
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
    })
}
