//! `bench cuts`: thread load of a trainee while other trainees cut beside the press.
//!
//! A probe presses a model, slides slowly and trembles. Every half second a short cut arrives from the
//! operation log, at least 14 mm away: 250 solver steps and 30 views per second of virtual time. Site, cut
//! worker and view run in turn on one thread, so that load of other programs matters only through the caches.
//! The cut worker is busy in virtual time for the duration of its work. All times are processor time.

use std::fmt;
use std::sync::Arc;

use clap::Args;
use nalgebra::Vector3;
use palpate_client::realtime::worked;
use palpate_device::Pose;
use palpate_protocol::clock::ClockMap;
use palpate_protocol::handshake::{RosterEntry, Welcome};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, Operation, OperationKind,
};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, Epoch, LocalSample, ModelHash, ModelInfo, OperationId, ParticipantId, ResumeToken,
    Role, ServerTime, Span, TopologyHash,
};
use palpate_site::{
    HAPTIC_PERIOD, MadeCut, Prefetch, Site, SiteError, VIEW_ITERATIONS, VIEW_TOLERANCE, View,
    ViewUpdate, hand_budget, tissue_stroke,
};
use palpate_tissue::{Budget, Topology, cut};
use serde::Serialize;

use super::work::Work;
use super::{Benchmark, OnStage};
use crate::test_model::TestModel;
use crate::tool_location::ToolLocation;

const RADIUS_M: f64 = 8e-3;
/// Time before the first cut, between cuts and after the last one, ms.
const APART_MS: i64 = 500;
const BEGINNING: usize = 50;
/// Steps around the application of a cut that belong to it, half of them before.
const AROUND: usize = 10;
/// Slow slide along the surface: amplitude in m, and frequency in Hz.
const SLIDE: (f64, f64) = (3e-3, 0.4);
/// Tremor along the normal: amplitude in m, and frequency in Hz.
const TREMOR: (f64, f64) = (0.05e-3, 9.0);
/// Views per second, and the limits of a view.
const VIEW_HZ: u32 = 30;
const VIEW_WORK: Span = Span::from_millis(5);
/// Length and depth of a cut, m, and its distance from the press.
const CUT_LENGTH_M: f64 = 0.02;
const CUT_DEPTH_M: f64 = 0.012;
const BESIDE_M: f64 = 0.014;
/// Blade length outside the tissue, m.
const OUTSIDE_M: f64 = 0.006;
const POINTS: usize = 20;

const ME: ParticipantId = ParticipantId(1);
const SURGEON: ParticipantId = ParticipantId(2);

#[derive(Debug, Clone, Args)]
pub struct CutLoad {
    /// A model file (.palp), a scene (.toml), or a sample: thigh, abdominal-wall, leg, handle
    #[arg(default_value = "thigh")]
    model: String,
    /// Number of cuts
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..=100))]
    cuts: u16,
    /// Time from the arrival of a cut to its due time, ms: the artificial delay
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(0..=400))]
    delay_ms: u16,
    /// Depth of the press, mm
    #[arg(long, default_value_t = 8.0)]
    depth_mm: f64,
}

impl Benchmark for CutLoad {
    type Report = CutsReport;

    fn measure(&self, progress: &mut OnStage<'_>) -> Result<CutsReport, String> {
        if !(0.5..=30.0).contains(&self.depth_mm) {
            let depth = self.depth_mm;
            return Err(format!("--depth-mm {depth} must be from 0.5 to 30"));
        }
        let model = TestModel::in_memory(&self.model, progress)?;
        let cuts = usize::from(self.cuts);
        let delay = Span::from_millis(i64::from(self.delay_ms));
        let topology = Topology::new(Arc::clone(&model));
        let location = ToolLocation::find(&topology)?;
        progress("making the cuts");
        let mut operations = operations(cuts, topology.clone(), &location)?;
        let mut site = Site::new(&welcome(&topology, delay), Arc::clone(&model), None);
        let mut now = ClientTime::ZERO;
        for event in [
            ClientEvent::CaughtUp,
            ClientEvent::Clock(ClockMap::exact(Span::ZERO)),
        ] {
            site.handle_event(event, now).map_err(|e| e.to_string())?;
        }
        let (ahead, mut view) = site.detach().ok_or("the site gives no cut worker")?;
        let mut worker = Worker::new(ahead);
        progress("pressing");
        let steps_apart = APART_MS * 1000 / HAPTIC_PERIOD.as_micros();
        let (mut due, mut steps, mut views) = (Vec::new(), Vec::new(), Vec::new());
        for k in 1..steps_apart * (i64::from(self.cuts) + 1) {
            now = now + HAPTIC_PERIOD;
            if k % steps_apart == 0 {
                let operation = &mut operations[due.len()];
                operation.at = ServerTime::from_micros(now.as_micros());
                due.push(operation.at + delay);
                let event = ClientEvent::Operation(operation.clone());
                site.handle_event(event, now).map_err(|e| e.to_string())?;
            }
            let news = worker.work(now)?;
            let pose = self.pose(&location, now.as_micros() as f64 * 1e-6);
            let step =
                Step::make(&mut site, &mut worker, news, pose, now).map_err(|e| e.to_string())?;
            steps.push(step);
            site.handle_own(&LocalSample {
                time: now,
                pose: palpate_protocol::Pose {
                    position_m: pose.position.into(),
                    ..palpate_protocol::Pose::IDENTITY
                },
                buttons: 0,
                force_n: None,
            });
            if let Some(ms) = show(&mut site, &mut view, now) {
                views.push(ms);
            }
        }
        let seconds = now.as_micros() as f64 * 1e-6;
        Ok(summary(
            &topology,
            &steps,
            &due,
            &views,
            worker.worked,
            seconds,
        ))
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct AtCut {
    /// Time from its due time to the step that applied it, ms.
    pub late_ms: f64,
    /// Longest of the ten steps around it, processor time in ms.
    pub worst_ms: f64,
    /// Force change in the step that applied it, N.
    pub jump_n: f64,
    /// Force before it, N.
    pub force_n: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct CutsReport {
    pub nodes: usize,
    /// Solver steps without a cut.
    pub steps: Work,
    /// Processor time of the solver thread per second, in cores.
    pub hand_cores: f64,
    pub views: Work,
    pub view_cores: f64,
    /// Processor time of the cut worker per cut, ms.
    pub worker_ms: f64,
    /// Solver steps in contact without a usable model.
    pub unusable: usize,
    pub worst_ms: f64,
    pub cuts: Vec<AtCut>,
}

struct Step {
    ms: f64,
    force: Vector3<f64>,
    is_usable: bool,
    version: u32,
    at: ServerTime,
}

impl CutLoad {
    fn pose(&self, location: &ToolLocation, t: f64) -> Pose {
        let wave = |(amplitude, hz): (f64, f64)| amplitude * (std::f64::consts::TAU * hz * t).sin();
        let reached = (t / 0.15).min(1.0);
        let depth = self.depth_mm * 1e-3 * (2.0 * reached - 1.0) + wave(TREMOR);
        let along = location.v * wave(SLIDE);
        Pose {
            position: location.middle + along + location.normal * (RADIUS_M - depth),
            ..Pose::default()
        }
    }
}

fn operations(
    wanted: usize,
    mut topology: Topology,
    location: &ToolLocation,
) -> Result<Vec<Operation>, String> {
    let mut operations = Vec::new();
    let spacing = location.spacing_m;
    // Candidates on both sides of the press, at increasing distances.
    for i in 0.. {
        if operations.len() == wanted {
            break;
        }
        if i == 20 * wanted {
            let made = operations.len();
            return Err(format!(
                "the model has room for only {made} of {wanted} cuts"
            ));
        }
        let side = if i % 2 == 0 { 1.0 } else { -1.0 };
        let (row, along) = (i / 2 % 4, i / 8);
        let across = side * (BESIDE_M + 1.5 * spacing * row as f64);
        let start = (along as f64 - 2.0) * (CUT_LENGTH_M / 2.0);
        let points = (0..=POINTS).map(|k| {
            let s = start + CUT_LENGTH_M * (k as f64 / POINTS as f64 - 0.5);
            let tip = location.surface(across, s).at - location.normal * CUT_DEPTH_M;
            BladePoint {
                tip_m: tip.into(),
                axis: location.normal.into(),
                depth_m: CUT_DEPTH_M + OUTSIDE_M,
            }
        });
        let stroke = CutStroke {
            began: ServerTime::from_micros(i as i64),
            joins: false,
            points: points.collect(),
            width_m: 0.0,
        };
        let before = topology.version();
        if cut(&mut topology, &tissue_stroke(SURGEON, &stroke).path).is_err() {
            continue;
        }
        operations.push(Operation {
            id: OperationId(operations.len() as u64),
            at: ServerTime::ZERO,
            author: SURGEON,
            topology_version_before: before,
            topology_version_after: topology.version(),
            hash_after: TopologyHash(topology.hash().0),
            kind: OperationKind::Cut(stroke),
        });
    }
    Ok(operations)
}

fn welcome(topology: &Topology, delay: Span) -> Welcome {
    Welcome {
        participant: ME,
        epoch: Epoch(1),
        role: Role::Trainee,
        server_time: ServerTime::ZERO,
        model: ModelInfo {
            hash: ModelHash(0),
            bytes: 0,
        },
        roster: vec![RosterEntry {
            participant: ME,
            name: "hand".to_owned(),
            role: Role::Trainee,
            tool: Some(ToolDescription::probe(RADIUS_M)),
        }],
        topology_version: topology.version(),
        topology_hash: TopologyHash(topology.hash().0),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far: 0,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: delay.as_micros() as u32,
        },
        tick_hz: VIEW_HZ,
        session_started_at: None,
        resume_token: ResumeToken([0; 16]),
    }
}

/// The cut worker, simulated as a separate thread.
struct Worker {
    ahead: Prefetch,
    /// Result of the latest work item, and its completion time.
    news: Option<MadeCut>,
    busy_until: ClientTime,
    worked: Span,
}

impl Worker {
    fn new(ahead: Prefetch) -> Self {
        Self {
            ahead,
            news: None,
            busy_until: ClientTime::ZERO,
            worked: Span::ZERO,
        }
    }

    /// Works until `now`; returns the results completed by then.
    fn work(&mut self, now: ClientTime) -> Result<Vec<MadeCut>, String> {
        let mut done = Vec::new();
        while self.busy_until <= now {
            done.extend(self.news.take());
            if !self.ahead.can_work() {
                self.busy_until = now;
                break;
            }
            let from = worked();
            self.news = self.ahead.work().map_err(|e| e.to_string())?;
            let took = worked() - from;
            self.worked += took;
            self.busy_until = self.busy_until + took;
        }
        Ok(done)
    }
}

impl Step {
    fn make(
        site: &mut Site,
        worker: &mut Worker,
        news: Vec<MadeCut>,
        pose: Pose,
        now: ClientTime,
    ) -> Result<Self, SiteError> {
        let from = worked();
        let mut orders = Vec::new();
        for news in news {
            site.handle_cut(news);
        }
        site.advance(now)?;
        let at_first = worked();
        let mut stop = || worked() - at_first > HAPTIC_PERIOD;
        let model = site.haptic_step(now, pose, 0, hand_budget(&mut stop));
        orders.extend(std::iter::from_fn(|| site.poll_cut_order()));
        let took = worked() - from;
        for order in orders {
            worker.ahead.order(order);
        }
        Ok(Self {
            ms: took.as_secs_f64() * 1e3,
            force: model.map_or_else(Vector3::zeros, |m| m.force()),
            is_usable: model.is_some_and(|m| m.is_usable() && m.in_contact()),
            version: site.replica().topology().version(),
            at: ServerTime::from_micros(now.as_micros()),
        })
    }
}

/// Solves the newest view if it is due; returns its duration in ms.
fn show(site: &mut Site, view: &mut View, now: ClientTime) -> Option<f64> {
    let from = worked();
    while let Some(news) = site.poll_view_update() {
        if let ViewUpdate::Cut(cut) = news {
            view.take(*cut);
        }
    }
    let frame = site.next_view(now)?;
    let mut stop = || worked() - from > VIEW_WORK;
    let budget = Budget {
        near: false,
        iterations: VIEW_ITERATIONS,
        tolerance: VIEW_TOLERANCE,
        stop: Some(&mut stop),
    };
    view.step(frame.s, &frame.tools, budget);
    Some((worked() - from).as_secs_f64() * 1e3)
}

fn summary(
    topology: &Topology,
    steps: &[Step],
    due: &[ServerTime],
    views: &[f64],
    worker: Span,
    seconds: f64,
) -> CutsReport {
    let mut quiet = vec![true; steps.len()];
    quiet[..BEGINNING.min(steps.len())].fill(false);
    let mut cuts = Vec::new();
    let exchanges = (1..steps.len()).filter(|&i| steps[i].version != steps[i - 1].version);
    for (i, due) in exchanges.zip(due) {
        let around = i.saturating_sub(AROUND / 2)..(i + AROUND / 2).min(steps.len());
        let ms = |k: usize| steps[k].ms;
        quiet[around.clone()].fill(false);
        cuts.push(AtCut {
            late_ms: (steps[i].at - *due).as_secs_f64() * 1e3,
            worst_ms: around.map(ms).fold(0.0, f64::max),
            jump_n: (steps[i].force - steps[i - 1].force).norm(),
            force_n: steps[i - 1].force.norm(),
        });
    }
    let times = |keep: &dyn Fn(usize) -> bool| -> Vec<f64> {
        let kept = (0..steps.len()).filter(|&i| keep(i));
        kept.map(|i| steps[i].ms).collect()
    };
    let all: f64 = steps.iter().map(|s| s.ms).sum();
    CutsReport {
        nodes: topology.node_count(),
        steps: Work::of(&times(&|i| quiet[i])),
        hand_cores: all * 1e-3 / seconds,
        views: Work::of(views),
        view_cores: views.iter().sum::<f64>() * 1e-3 / seconds,
        worker_ms: worker.as_secs_f64() * 1e3 / cuts.len().max(1) as f64,
        unusable: steps[BEGINNING.min(steps.len())..]
            .iter()
            .filter(|s| !s.is_usable)
            .count(),
        worst_ms: cuts.iter().map(|c| c.worst_ms).fold(0.0, f64::max),
        cuts,
    }
}

impl fmt::Display for CutsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} nodes; processor time in ms", self.nodes)?;
        let all = [
            ("step", self.steps, self.hand_cores),
            ("view", self.views, self.view_cores),
        ];
        for (name, w, cores) in all {
            writeln!(
                f,
                "{name}: mean {:.2}, p50 {:.2}, p99 {:.2}, max {:.2} of {}; {cores:.3} cores",
                w.mean_ms, w.p50_ms, w.p99_ms, w.max_ms, w.count
            )?;
        }
        writeln!(
            f,
            "cut worker: {:.0} per cut; steps without a usable model: {}",
            self.worker_ms, self.unusable
        )?;
        writeln!(
            f,
            "{:>8} {:>8} {:>10} {:>10}",
            "late", "worst", "jump (N)", "force (N)"
        )?;
        for c in &self.cuts {
            writeln!(
                f,
                "{:>8.1} {:>8.2} {:>10.3} {:>10.3}",
                c.late_ms, c.worst_ms, c.jump_n, c.force_n
            )?;
        }
        write!(f, "worst step around a cut: {:.2}", self.worst_ms)
    }
}
