use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, LeaveReason,
};
pub(super) use palpate_protocol::request::RequestRefused;
use palpate_protocol::tool::ToolKind;
use palpate_protocol::{Epoch, ModelHash, ModelInfo, Pose, ResumeToken, Role, ToolTrack};
pub(super) use palpate_protocol::{OperationId, RequestId};

use super::resync_policy::DRIFT_MAX_M;
use super::*;
pub(super) use crate::replica::Drift;
use crate::test_support::soft_block;

pub(super) const ME: ParticipantId = ParticipantId(1);
pub(super) const OTHER: ParticipantId = ParticipantId(2);

fn model() -> Arc<Model> {
    soft_block([6, 6, 4])
}

fn tool(kind: ToolKind) -> ToolDescription {
    match kind {
        ToolKind::Scalpel => ToolDescription::scalpel(4e-3, 0.02),
        _ => ToolDescription::probe(4e-3),
    }
}

fn entry(participant: ParticipantId, kind: ToolKind) -> RosterEntry {
    RosterEntry {
        participant,
        name: participant.to_string(),
        role: Role::Trainee,
        tool: Some(tool(kind)),
    }
}

pub(super) fn welcome(delay_us: u32) -> Welcome {
    let topology = palpate_tissue::Topology::new(model());
    Welcome {
        participant: ME,
        epoch: Epoch(1),
        role: Role::Trainee,
        server_time: ServerTime::ZERO,
        model: ModelInfo {
            hash: ModelHash(0),
            bytes: 0,
        },
        roster: vec![entry(ME, ToolKind::Scalpel), entry(OTHER, ToolKind::Probe)],
        topology_version: 0,
        topology_hash: TopologyHash(topology.hash().0),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far: 0,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: delay_us,
        },
        tick_hz: 250,
        session_started_at: None,
        resume_token: ResumeToken([0; 16]),
    }
}

/// A site whose clock is 5 s behind the server's.
pub(super) fn site(delay_us: u32) -> Site {
    let mut site = Site::new(&welcome(delay_us), model(), Some(0.02));
    let map = ClockMap::exact(Span::from_millis(5000));
    tell(&mut site, ClientEvent::CaughtUp, 0);
    tell(&mut site, ClientEvent::Clock(map), 0);
    site
}

pub(super) fn ms(t: i64) -> ClientTime {
    ClientTime::from_micros(t * 1000)
}

pub(super) fn tell(site: &mut Site, event: ClientEvent, t: i64) {
    site.handle_event(event, ms(t)).unwrap();
}

pub(super) fn budget() -> Budget<'static> {
    Budget::new(3, 1e-2)
}

pub(super) fn operation(id: u64, at_ms: i64, kind: OperationKind) -> ClientEvent {
    ClientEvent::Operation(Operation {
        id: OperationId(id),
        at: ServerTime::from_micros(at_ms * 1000),
        author: OTHER,
        topology_version_before: 0,
        topology_version_after: 0,
        hash_after: TopologyHash(0),
        kind,
    })
}

pub(super) fn own(t: i64, x: f64, pressed: bool) -> LocalSample {
    LocalSample {
        time: ms(t),
        pose: Pose {
            position_m: [x, 0.012, 0.016],
            ..Pose::IDENTITY
        },
        buttons: u8::from(pressed),
        force_n: None,
    }
}

#[test]
fn each_grid_point_is_solved_once_and_late_sites_skip_to_newest() {
    let mut site = site(50_000);
    let first = site.view_step(ms(101), budget()).unwrap();
    // 5101 - 50 = 5051 ms; the grid has a point every 4 ms.
    assert_eq!(first.s, ServerTime::from_micros(5_048_000));
    assert_eq!(first.delay, Span::from_millis(50));
    assert_eq!(site.view_step(ms(101), budget()), None);
    let next = site.view_step(ms(102), budget()).unwrap();
    assert_eq!(next.s, ServerTime::from_micros(5_052_000));
    let later = site.view_step(ms(115), budget()).unwrap();
    assert_eq!(later.k, next.k + 3);
    assert_eq!(site.counters().views_skipped, 2);
}

#[test]
fn grid_works_for_rates_that_do_not_divide_a_second() {
    for hz in [30, 60, 250, 333] {
        for us in (0..200_000).step_by(997) {
            let s = ServerTime::from_micros(us);
            let k = grid_index(s, hz);
            assert!(
                grid_time(k, hz) <= s && s < grid_time(k + 1, hz),
                "{hz} {us}"
            );
        }
    }
}

#[test]
fn tools_in_a_view_are_from_the_same_time() {
    let mut site = site(20_000);
    for t in 0..100 {
        site.handle_own(&own(t, t as f64 * 1e-4, false));
        let sample = ToolSample {
            time: ServerTime::from_micros((5000 + t) * 1000),
            pose: own(t, t as f64 * 1e-4, false).pose,
            ..ToolSample::default()
        };
        let track = ToolTrack {
            participant: OTHER,
            samples: vec![sample],
            ..ToolTrack::default()
        };
        tell(&mut site, ClientEvent::Motion(track), t);
    }
    let frame = site.view_step(ms(99), budget()).unwrap();
    assert_eq!(frame.tools.len(), 2);
    assert!((frame.tools[0].position - frame.tools[1].position).norm() < 1e-9);
    assert!(
        (frame.tools[0].position.x - 76e-4).abs() < 1e-6,
        "{frame:?}"
    );
}

#[test]
fn left_participant_is_shown_until_its_leave_time() {
    let mut site = site(50_000);
    let left = OperationKind::Left {
        participant: OTHER,
        reason: LeaveReason::Left,
    };
    tell(&mut site, operation(0, 5100, left), 110);
    site.advance(ms(140)).unwrap();
    assert_eq!(site.roster().count(), 2);
    site.advance(ms(150)).unwrap();
    assert_eq!(site.roster().count(), 1);
    let applied = site.poll_applied().unwrap();
    assert_eq!(
        (applied.kind.as_str(), applied.applied_us),
        ("left", 150_000)
    );
}

#[test]
fn script_start_is_converted_to_client_clock() {
    let mut site = site(0);
    assert_eq!(site.script_start(), None);
    let at = ServerTime::from_micros(6_000_000);
    tell(
        &mut site,
        operation(0, 5100, OperationKind::Started { at }),
        100,
    );
    assert_eq!(site.script_start(), Some(ms(1000)));
}

#[test]
fn released_blade_requests_cut_and_refusal_is_reported() {
    let mut site = site(0);
    for t in 0..50 {
        site.handle_own(&own(t, t as f64 * 2e-4, true));
    }
    site.handle_own(&own(50, 0.01, false));
    let Some(RequestKind::Cut(cut)) =
        std::iter::from_fn(|| site.poll_request()).find(|r| matches!(r, RequestKind::Cut(_)))
    else {
        panic!("a cut is asked for");
    };
    assert!(cut.is_valid());
    assert_eq!(cut.points[0].time, ServerTime::from_micros(5_000_000));
    let refused = RequestRefused {
        id: RequestId(1),
        reason: RequestRefusal::NothingCut,
    };
    tell(&mut site, ClientEvent::RequestRefused(refused), 60);
    assert!(
        site.poll_notice()
            .unwrap()
            .contains("does not pass through")
    );
    assert_eq!(site.counters().cuts_refused, 1);
}

#[test]
fn initial_difference_causes_one_resync_then_error() {
    let other = Welcome {
        topology_hash: TopologyHash(1),
        ..welcome(0)
    };
    let mut site = Site::new(&other, model(), None);
    assert!(site.view_step(ms(10), budget()).is_none());
    tell(&mut site, ClientEvent::CaughtUp, 0);
    assert!(site.is_resyncing() && site.poll_resync().is_some());
    tell(&mut site, ClientEvent::Welcomed(Box::new(other)), 100);
    let error = site
        .handle_event(ClientEvent::CaughtUp, ms(200))
        .unwrap_err();
    let sentence = error.to_string();
    assert!(matches!(error, SiteError::Again(_)), "{error}");
    assert!(sentence.contains("0000000000000001"), "{sentence}");
}

pub(super) fn cut_of(hash_after: TopologyHash) -> ClientEvent {
    let point = |i: u32| BladePoint {
        tip_m: [4e-3 * f64::from(i), 0.0105, 6e-3],
        axis: [0.0, 0.0, 1.0],
        depth_m: 0.02,
    };
    ClientEvent::Operation(Operation {
        id: OperationId(0),
        at: ServerTime::from_micros(5_100_000),
        author: OTHER,
        topology_version_before: 0,
        topology_version_after: 1,
        hash_after,
        kind: OperationKind::Cut(CutStroke {
            began: ServerTime::ZERO,
            joins: false,
            points: (0..7).map(point).collect(),
            width_m: 0.0,
        }),
    })
}

/// The hash after [`cut_of`], as an unmodified replica computes it.
pub(super) fn hash_of_the_cut() -> TopologyHash {
    let ClientEvent::Operation(operation) = cut_of(TopologyHash(0)) else {
        unreachable!()
    };
    let OperationKind::Cut(stroke) = &operation.kind else {
        unreachable!()
    };
    let mut topology = palpate_tissue::Topology::new(model());
    palpate_tissue::cut(
        &mut topology,
        &crate::tools::tissue_stroke(OTHER, stroke).path,
    )
    .unwrap();
    TopologyHash(topology.hash().0)
}

#[test]
fn resync_restores_replica_after_different_cut() {
    let truth = hash_of_the_cut();
    let mut site = site(0);
    tell(&mut site, cut_of(TopologyHash(1)), 110);
    site.advance(ms(120)).unwrap();
    assert!(site.is_resyncing(), "no force during a resync");
    let why = site.poll_resync().unwrap();
    assert!(why.contains("the server's is 0000000000000001"), "{why}");
    assert_eq!(site.poll_resync(), None, "asked for once");
    // Further events of the old connection do not affect the new replica.
    tell(
        &mut site,
        operation(1, 5130, OperationKind::Reconnected { participant: OTHER }),
        130,
    );
    assert!(site.view_step(ms(140), budget()).is_none());
    let again = Welcome {
        operations_so_far: 1,
        topology_version: 1,
        topology_hash: truth,
        ..welcome(0)
    };
    tell(&mut site, ClientEvent::Welcomed(Box::new(again)), 150);
    tell(&mut site, cut_of(truth), 151);
    tell(&mut site, ClientEvent::CaughtUp, 152);
    assert!(!site.is_resyncing());
    assert_eq!(site.replica().topology().hash().0, truth.0);
    assert_eq!((site.counters().resyncs, site.counters().cuts), (1, 1));
    assert!(site.view_step(ms(160), budget()).is_some());
    let shown = site.replica().view().unwrap().topology().version();
    assert_eq!(shown, 1, "the shapes have the cuts of the log");
    assert!(site.detach().is_some(), "cuts are made ahead again");
}

#[test]
fn lasting_drift_causes_resync_unless_demoted() {
    let mut site = site(0);
    let drift = Drift {
        max_m: 2.0 * DRIFT_MAX_M,
        nodes: 1,
    };
    let mut asked = Vec::new();
    for t in (0..6000).step_by(100) {
        let view = site.view_step(ms(t), budget()).unwrap().s;
        if t == 1500 {
            let kind = OperationKind::Demoted {
                participant: ME,
                wanted_us: 500_000,
                cap_us: 400_000,
            };
            tell(&mut site, operation(0, 5000 + t, kind), t);
        } else if t == 4000 {
            let kind = OperationKind::Restored { participant: ME };
            tell(&mut site, operation(1, 5000 + t, kind), t);
        }
        site.advance(ms(t)).unwrap();
        site.handle_drift(view, drift, ms(t));
        if site.poll_resync().is_some() {
            asked.push(t);
            break;
        }
    }
    assert_eq!(asked, [5000], "a second after it takes part again");
    assert_eq!(site.counters().demotions, 1);
}

#[test]
fn log_gap_after_reconnect_causes_resync() {
    let mut site = site(0);
    tell(
        &mut site,
        operation(0, 5010, OperationKind::Reconnected { participant: OTHER }),
        20,
    );
    let further = Welcome {
        first_operation: OperationId(7),
        operations_so_far: 9,
        ..welcome(0)
    };
    tell(&mut site, ClientEvent::Welcomed(Box::new(further)), 30);
    assert!(site.poll_resync().unwrap().contains("resumes at"));
    // The site accepts a server that sends the whole log unasked.
    tell(&mut site, ClientEvent::Welcomed(Box::new(welcome(0))), 40);
    tell(&mut site, ClientEvent::CaughtUp, 41);
    assert!(!site.is_resyncing() && site.counters().resyncs == 1);
}

#[test]
fn demoted_hand_has_no_force_until_restored() {
    let mut site = site(0);
    let at = palpate_device::Pose {
        position: nalgebra::Vector3::new(0.0121, 0.0119, 0.013),
        ..palpate_device::Pose::default()
    };
    let felt = |site: &mut Site, t: i64| {
        let model = site.haptic_step(ms(t), at, 0, budget()).unwrap();
        model != palpate_haptics::ContactModel::absent_at(ms(t), 0)
    };
    assert!(felt(&mut site, 10));
    let kind = OperationKind::Demoted {
        participant: ME,
        wanted_us: 530_000,
        cap_us: 400_000,
    };
    tell(&mut site, operation(0, 5020, kind), 20);
    site.advance(ms(30)).unwrap();
    assert!(site.is_demoted() && !felt(&mut site, 40));
    let said = site.poll_notice().unwrap();
    assert!(said.contains("530 ms") && said.contains("400"), "{said}");
    let kind = OperationKind::Restored { participant: ME };
    tell(&mut site, operation(1, 5050, kind), 50);
    site.advance(ms(60)).unwrap();
    assert!(!site.is_demoted() && felt(&mut site, 70));
}

#[test]
fn resting_hand_is_not_solved_again() {
    let mut site = site(0);
    let at = |depth_mm: f64| palpate_device::Pose {
        position: nalgebra::Vector3::new(0.0121, 0.0119, 0.013 - 1e-3 * depth_mm),
        ..palpate_device::Pose::default()
    };
    let solves = |site: &mut Site, t: i64, depth_mm: f64| {
        let before = site.counters().haptic_solves;
        let model = site.haptic_step(ms(t), at(depth_mm), 0, budget()).unwrap();
        assert!(model.in_contact() && model.solved_at == ms(t));
        site.counters().haptic_solves - before
    };
    // Every step solves until the forces are steady.
    let begun: u64 = (0..100).map(|k| solves(&mut site, 4 * k, 0.0)).sum();
    assert!((20..100).contains(&begun), "{begun}");
    let resting: Vec<u64> = (100..110).map(|k| solves(&mut site, 4 * k, 0.0)).collect();
    assert_eq!(resting.iter().sum::<u64>(), 2, "every 20 ms: {resting:?}");
    assert_eq!(solves(&mut site, 440, 0.17), 1);
    for k in 111..200 {
        solves(&mut site, 4 * k, 0.17);
    }
    let small: u64 = (200..210).map(|k| solves(&mut site, 4 * k, 0.25)).sum();
    // One solve changes the force, and another one follows.
    assert!(small <= 4, "{small} after less than 0.15 mm");
}

#[test]
fn spectator_has_no_contact_model() {
    let welcome = Welcome {
        role: Role::Spectator,
        ..welcome(0)
    };
    let mut site = Site::new(&welcome, model(), None);
    assert!(
        site.haptic_step(ms(0), palpate_device::Pose::default(), 0, budget())
            .is_none()
    );
}

#[test]
fn haptic_shape_follows_other_tools_between_grid_points() {
    let slow = Welcome {
        tick_hz: 10,
        ..welcome(0)
    };
    let mut site = Site::new(&slow, model(), None);
    tell(&mut site, ClientEvent::CaughtUp, 0);
    tell(
        &mut site,
        ClientEvent::Clock(ClockMap::exact(Span::ZERO)),
        0,
    );
    for t in 0..100 {
        let sample = ToolSample {
            time: ServerTime::from_micros(t * 1000),
            pose: own(t, t as f64 * 1e-4, false).pose,
            ..ToolSample::default()
        };
        site.roster.insert(OTHER, sample);
    }
    let at = |site: &mut Site, t: i64| {
        let (s, _) = site.common_time(ms(t)).unwrap();
        site.roster.haptic_tools_at(s, ME)[0].position.x
    };
    assert!(site.view_step(ms(50), budget()).is_some());
    assert!((at(&mut site, 50) - 50e-4).abs() < 1e-9);
    assert!((at(&mut site, 70) - 70e-4).abs() < 1e-9);
    assert!(site.view_step(ms(70), budget()).is_none());
}

#[test]
fn view_continues_after_clock_correction() {
    const HOURS_MS: i64 = 3 * 3_600_000;
    let mut site = site(0);
    site.handle_own(&own(1000, 0.01, false));
    assert!(site.next_view(ms(1000)).is_some());
    // Clock set ahead: until the session detects it, the old map is hours ahead.
    let ahead = |t: i64| t + HOURS_MS;
    site.handle_own(&own(ahead(1004), 0.01, false));
    let wrong = site.next_view(ms(ahead(1004))).expect("a view");
    assert!(wrong.s > ServerTime::from_micros(HOURS_MS * 1000));
    let map = ClockMap::exact(Span::from_millis(5000 - HOURS_MS));
    tell(&mut site, ClientEvent::Clock(map), ahead(1400));
    site.handle_own(&own(ahead(1400), 0.02, false));
    let right = site.next_view(ms(ahead(1404))).expect("a view at once");
    assert_eq!(right.s, ServerTime::from_micros(6_404_000));
    let tool = right.tools.iter().find(|t| t.participant == ME);
    assert!(
        tool.is_some_and(|t| t.strength > 0.0),
        "the own tool also continues"
    );
    assert!(site.next_view(ms(ahead(1408))).is_some());
}

#[test]
fn resync_is_requested_once() {
    let mut site = site(0);
    tell(&mut site, cut_of(TopologyHash(1)), 110);
    site.advance(ms(120)).unwrap();
    assert!(site.poll_resync().is_some());
    let late = ReplicaError::Version {
        operation: "operation 0".into(),
        expected: 1,
        found: 0,
    };
    assert_eq!(site.handle_broken(late, ms(130)), Ok(()));
    assert_eq!(site.poll_resync(), None);
}

#[test]
fn simultaneous_cuts_give_one_topology_report() {
    let mut topology = palpate_tissue::Topology::new(model());
    let mut site = site(0);
    for (id, y) in [0.0045, 0.0105, 0.0165].into_iter().enumerate() {
        let ClientEvent::Operation(mut operation) = cut_of(TopologyHash(0)) else {
            unreachable!()
        };
        let OperationKind::Cut(stroke) = &mut operation.kind else {
            unreachable!()
        };
        stroke.began = ServerTime::from_micros(id as i64);
        for point in &mut stroke.points {
            point.tip_m[1] = y;
        }
        palpate_tissue::cut(
            &mut topology,
            &crate::tools::tissue_stroke(OTHER, stroke).path,
        )
        .unwrap();
        operation.id = OperationId(id as u64);
        operation.topology_version_before = id as u32;
        operation.topology_version_after = topology.version();
        operation.hash_after = TopologyHash(topology.hash().0);
        tell(&mut site, ClientEvent::Operation(operation), 110);
    }
    while site.poll_request().is_some() {}
    site.advance(ms(120)).unwrap();
    assert_eq!(site.counters().cuts, 3);
    let requests: Vec<RequestKind> = std::iter::from_fn(|| site.poll_request()).collect();
    let hash = TopologyHash(topology.hash().0);
    assert_eq!(requests, [RequestKind::TopologyReport { version: 3, hash }]);
}

#[test]
fn thin_site_stays_thin_after_resync() {
    let mut site = Site::thin(&welcome(0), model(), None);
    tell(&mut site, ClientEvent::CaughtUp, 0);
    let further = Welcome {
        first_operation: OperationId(7),
        operations_so_far: 9,
        ..welcome(0)
    };
    tell(&mut site, ClientEvent::Welcomed(Box::new(further)), 10);
    assert!(site.poll_resync().is_some());
    tell(&mut site, ClientEvent::Welcomed(Box::new(welcome(0))), 20);
    tell(&mut site, ClientEvent::CaughtUp, 21);
    assert!(site.is_thin() && !site.is_resyncing());
    assert_eq!(site.counters().resyncs, 1);
}

#[test]
fn only_new_participants_give_notices() {
    let joined = |id: u64| {
        let kind = OperationKind::Joined {
            participant: ParticipantId(id as u16 + 3),
            name: format!("guest {id}"),
            role: Role::Trainee,
            tool: None,
        };
        operation(id, 5010 + id as i64, kind)
    };
    let mut site = Site::new(&welcome(0), model(), None);
    tell(&mut site, joined(0), 0);
    tell(&mut site, ClientEvent::CaughtUp, 0);
    let map = ClockMap::exact(Span::from_millis(5000));
    tell(&mut site, ClientEvent::Clock(map), 0);
    tell(&mut site, joined(1), 20);
    tell(&mut site, joined(2), 20);
    site.advance(ms(40)).unwrap();
    let said: Vec<String> = std::iter::from_fn(|| site.poll_notice()).collect();
    assert_eq!(said, ["guest 1 joined", "guest 2 joined"]);
}
