//! Laws of prefetched cuts, in virtual time.

use std::sync::Arc;

use palpate_haptics::ContactModel;
use palpate_protocol::clock::ClockMap;
use palpate_protocol::handshake::{RosterEntry, Welcome};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, Operation, OperationKind,
};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, Epoch, ModelHash, ModelInfo, OperationId, ParticipantId, ResumeToken, Role,
    ServerTime, Span, TopologyHash,
};
use palpate_tissue::{Budget, Model, Tissue, Tool, Topology, Vec3, cut};

use super::super::{HAPTIC_TOLERANCE, View};
use super::*;
use crate::Site;
use crate::test_support::soft_block;

const CELL: f64 = 4e-3;
const ME: ParticipantId = ParticipantId(1);
const RADIUS_M: f64 = 8e-3;
/// Delay from arrival to due time, ms.
const DELAY_MS: i64 = 40;

fn tissue() -> Arc<Model> {
    soft_block([32, 16, 8])
}

/// Cuts across the block, far from the contact of the hand.
fn cuts(model: &Arc<Model>) -> Vec<Operation> {
    let mut topology = Topology::new(Arc::clone(model));
    let cut_at = |topology: &mut Topology, id: u64, x: f64| {
        let point = |i: u32| BladePoint {
            tip_m: [x, CELL * (4.0 + f64::from(i)), 4.1 * CELL],
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            began: ServerTime::ZERO,
            joins: false,
            points: (0..9).map(point).collect(),
            width_m: 0.0,
        };
        cut(topology, &tissue_stroke(ParticipantId(2), &stroke).path).unwrap();
        Operation {
            id: OperationId(id),
            at: ServerTime::ZERO,
            author: ParticipantId(2),
            topology_version_before: topology.version() - 1,
            topology_version_after: topology.version(),
            hash_after: TopologyHash(topology.hash().0),
            kind: OperationKind::Cut(stroke),
        }
    };
    let mut made = |(id, x)| cut_at(&mut topology, id, x);
    [(0, 22.4 * CELL), (1, 27.4 * CELL)].map(&mut made).into()
}

fn welcome(model: &Arc<Model>) -> Welcome {
    let topology = Topology::new(Arc::clone(model));
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
            name: "hand".into(),
            role: Role::Trainee,
            tool: Some(ToolDescription::probe(RADIUS_M)),
        }],
        topology_version: 0,
        topology_hash: TopologyHash(topology.hash().0),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far: 0,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: DELAY_MS as u32 * 1000,
        },
        tick_hz: 30,
        session_started_at: None,
        resume_token: ResumeToken([0; 16]),
    }
}

/// A pressing hand, its site and its cut worker, which runs only when the test allows it.
struct Bench {
    site: Site,
    prefetch: Prefetch,
    view: View,
    now: ClientTime,
    is_working: bool,
}

impl Bench {
    fn new(model: &Arc<Model>) -> Self {
        let mut site = Site::new(&welcome(model), Arc::clone(model), None);
        let now = ClientTime::ZERO;
        for event in [
            ClientEvent::CaughtUp,
            ClientEvent::Clock(ClockMap::exact(Span::ZERO)),
        ] {
            site.handle_event(event, now).unwrap();
        }
        let (prefetch, view) = site.detach().unwrap();
        Self {
            site,
            prefetch,
            view,
            now,
            is_working: true,
        }
    }

    /// Delivers a cut now; its due time is [`DELAY_MS`] later.
    fn arrive(&mut self, cut: &Operation) {
        let operation = Operation {
            at: ServerTime::from_micros(self.now.as_micros()),
            ..cut.clone()
        };
        let event = ClientEvent::Operation(operation);
        self.site.handle_event(event, self.now).unwrap();
    }

    /// One step of the hand, 4 ms later. Returns its model and the number of bricks visited.
    fn turn(&mut self) -> (ContactModel, usize) {
        self.now = self.now + Span::from_millis(4);
        while self.is_working && self.prefetch.can_work() {
            if let Some(news) = self.prefetch.work().unwrap() {
                self.site.handle_cut(news);
            }
        }
        self.site.advance(self.now).unwrap();
        let budget = Budget {
            near: true,
            iterations: 2,
            tolerance: HAPTIC_TOLERANCE,
            stop: None,
        };
        let pose = palpate_device::Pose {
            position: at(self.now),
            ..palpate_device::Pose::default()
        };
        let model = self.site.haptic_step(self.now, pose, 0, budget).unwrap();
        while let Some(order) = self.site.poll_cut_order() {
            self.prefetch.order(order);
        }
        while let Some(news) = self.site.poll_view_update() {
            if let crate::ViewUpdate::Cut(cut) = news {
                self.view.take(*cut);
            }
        }
        let tissue = self.site.replica().haptic.tissue().unwrap();
        (model, tissue.report().visits[0])
    }

    fn version(&self) -> u32 {
        self.site.replica().topology().version()
    }
}

/// The hand indents for 0.1 s, then slides along the block at 10 mm/s.
fn at(now: ClientTime) -> Vec3 {
    let t = now.as_micros() as f64 * 1e-6;
    let depth = 6e-3 * (t / 0.1).min(1.0);
    let x = 7.0 * CELL + 10e-3 * (t - 0.1).max(0.0);
    Vec3::new(x, 8.0 * CELL, 8.0 * CELL + RADIUS_M - depth)
}

/// The converged force on a tool that followed the hand's path, on the topology after these cuts.
fn converged(model: &Arc<Model>, cuts: &[Operation], now: ClientTime) -> Vec3 {
    let mut tissue = Tissue::new(Arc::clone(model));
    for operation in cuts {
        let OperationKind::Cut(stroke) = &operation.kind else {
            unreachable!("only cuts");
        };
        tissue
            .cut(&tissue_stroke(ParticipantId(2), stroke).path)
            .unwrap();
    }
    let mut force = Vec3::zeros();
    for ms in (0..=now.as_micros() / 1000).step_by(10) {
        let centre = at(ClientTime::from_micros(ms * 1000).min(now));
        let tool = Tool::ball(1, centre, RADIUS_M);
        let report = tissue.step(&[tool], Budget::new(60, 1e-5));
        force = report.reactions[0].force;
    }
    force
}

#[test]
fn hand_uses_old_topology_until_late_cut_is_ready() {
    let model = tissue();
    let cuts = cuts(&model);
    let mut bench = Bench::new(&model);
    for _ in 0..50 {
        bench.turn();
    }
    bench.is_working = false;
    bench.arrive(&cuts[0]);
    for turn in 0..50 {
        let (felt, _) = bench.turn();
        assert!(felt.is_usable() && felt.in_contact(), "turn {turn}");
        assert_eq!(bench.version(), 0, "turn {turn}");
    }
    bench.is_working = true;
    for turn in 0..6 {
        let (felt, _) = bench.turn();
        assert!(felt.is_usable() && felt.in_contact(), "turn {turn}");
    }
    assert_eq!(bench.version(), 1);
    let hash = bench.site.replica().topology().hash();
    assert_eq!(hash.0, cuts[0].hash_after.0);
    assert_eq!(bench.view.topology().hash(), hash);
}

#[test]
fn cut_is_applied_at_its_due_time() {
    let model = tissue();
    let cuts = cuts(&model);
    let mut bench = Bench::new(&model);
    for _ in 0..50 {
        bench.turn();
    }
    for (k, cut) in cuts.iter().enumerate() {
        bench.arrive(cut);
        for _ in 1..DELAY_MS / 4 {
            bench.turn();
            assert_eq!(bench.version(), k as u32);
        }
        bench.turn();
        assert_eq!(bench.version(), k as u32 + 1);
    }
}

#[test]
fn simultaneous_cuts_are_applied_in_log_order() {
    let model = tissue();
    let cuts = cuts(&model);
    let mut bench = Bench::new(&model);
    bench.turn();
    for cut in &cuts {
        bench.arrive(cut);
    }
    for _ in 0..2 * DELAY_MS / 4 {
        bench.turn();
    }
    let hash = bench.site.replica().topology().hash();
    assert_eq!(hash.0, cuts[1].hash_after.0);
}

/// The steps around an exchange visit no more bricks than other steps.
#[test]
fn exchange_adds_no_work_to_hand_steps() {
    let model = tissue();
    let cuts = cuts(&model);
    let mut bench = Bench::new(&model);
    let before: Vec<usize> = (0..75).map(|_| bench.turn().1).collect();
    let most = before[40..].iter().copied().max().unwrap();
    bench.arrive(&cuts[0]);
    for turn in 0..40 {
        let (_, bricks) = bench.turn();
        assert!(
            bricks <= most + most / 2,
            "turn {turn}: {bricks} bricks, at most {most} before the cut"
        );
    }
    assert_eq!(bench.version(), 1);
}

/// A cut far from the contact changes the force by at most the difference of the two converged solutions plus the
/// tolerance of the hand's steps.
#[test]
fn force_is_continuous_across_distant_cut() {
    let model = tissue();
    let cuts = cuts(&model);
    let mut bench = Bench::new(&model);
    let mut forces = Vec::new();
    for _ in 0..75 {
        forces.push((bench.now, 0, bench.turn().0.force()));
    }
    bench.arrive(&cuts[0]);
    for _ in 0..20 {
        let (felt, _) = bench.turn();
        forces.push((bench.now, bench.version(), felt.force()));
    }
    let exchange = forces.iter().position(|f| f.1 == 1).unwrap();
    let steps = |range: std::ops::Range<usize>| {
        let jumps = range.map(|i| (forces[i].2 - forces[i - 1].2).norm());
        jumps.fold(0.0, f64::max)
    };
    let usual = steps(60..exchange);
    let [before, after] =
        [&cuts[..0], &cuts[..1]].map(|cuts| converged(&model, cuts, forces[exchange].0));
    let allowed = (after - before).norm() + HAPTIC_TOLERANCE * after.norm() + usual;
    let jump = steps(exchange..exchange + 5);
    assert!(jump <= allowed, "{jump} N, allowed are {allowed} N");
    let error = (forces[exchange].2 - after).norm() / after.norm();
    assert!(error < 0.08, "{error}: {:?} {after:?}", forces[exchange].2);
}
