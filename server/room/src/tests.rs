//! The room with scripted peers in virtual time.

use std::sync::Arc;

use palpate_protocol::handshake::{Hello, ModelInfo, RefusalReason, Subscription};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, LeaveReason, Operation, OperationKind,
};
use palpate_protocol::request::{
    CutRequest, Request, RequestKind, RequestRefusal, TimedBladePoint,
};
use palpate_protocol::session::{CloseReason, PeerDatagram, PeerEvent, PeerMessage, PeerMotion};
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_protocol::{
    Epoch, Grant, ModelHash, Pose, RequestId, ResumeToken, Role, ServerTime, Span, ToolSample,
    TopologyHash,
};
use palpate_tissue::{Material, Model, block};

use crate::{Output, PeerKey, RoomConfig, SimulatedRoom};

mod controls;
mod demotion;
mod fairness;
mod invitations;
mod late_join;
mod motion;
mod seats;
mod snapshots;
mod stalls;
mod states;
mod thin;
mod tissue;

const TRAINEE: Grant = Grant([7; 16]);
const SPECTATOR: Grant = Grant([9; 16]);

fn model() -> Arc<Model> {
    let fat = Material::built_in("fat").unwrap();
    Arc::new(block([12, 12, 8], 0.004, &fat, 1))
}

fn room(start_when_tools: u16) -> SimulatedRoom {
    room_of(3, start_when_tools)
}

fn room_of(seats: u16, start_when_tools: u16) -> SimulatedRoom {
    room_with(seats, start_when_tools, CompensationMode::Fixed)
}

fn room_with(seats: u16, start_when_tools: u16, mode: CompensationMode) -> SimulatedRoom {
    let config = config(seats, start_when_tools, mode);
    SimulatedRoom::new(model(), config, ServerTime::ZERO)
}

pub(crate) fn config(seats: u16, start_when_tools: u16, mode: CompensationMode) -> RoomConfig {
    RoomConfig {
        epoch: Epoch(1),
        model: ModelInfo {
            hash: ModelHash(1),
            bytes: 1,
        },
        grants: vec![(Role::Trainee, TRAINEE), (Role::Spectator, SPECTATOR)],
        seats,
        spectators: seats,
        tick_hz: 50,
        compensation: CompensationSettings {
            mode,
            initial_delay_us: 20_000,
        },
        fresh_token: |who| ResumeToken([who.0 as u8; 16]),
        fresh_grant: |id| Grant((u128::MAX - u128::from(id)).to_le_bytes()),
        start_when_tools,
    }
}

fn hello(name: &str, role: Role, kind: ToolKind) -> PeerEvent {
    let grant = if role == Role::Spectator {
        SPECTATOR
    } else {
        TRAINEE
    };
    let tool = role.has_tool().then_some(match kind {
        ToolKind::Scalpel => ToolDescription::scalpel(0.008, 0.03),
        _ => ToolDescription::probe(0.008),
    });
    PeerEvent::Hello(Hello {
        name: name.into(),
        role,
        grant,
        tool,
        subscription: Subscription::Full,
        resume: None,
    })
}

fn ms(t: i64) -> ServerTime {
    ServerTime::from_micros(t * 1000)
}

fn drain(room: &mut SimulatedRoom) -> Vec<Output> {
    std::iter::from_fn(|| room.poll_output()).collect()
}

fn operations(outputs: &[Output], to: PeerKey) -> Vec<Arc<Operation>> {
    let ours = outputs.iter().filter_map(|o| match o {
        Output::Message(peer, PeerMessage::Operation(op)) if *peer == to => Some(Arc::clone(op)),
        _ => None,
    });
    ours.collect()
}

fn refusal(outputs: &[Output]) -> Option<RefusalReason> {
    outputs.iter().find_map(|o| match o {
        Output::Message(_, PeerMessage::Refused(r)) => Some(r.reason.clone()),
        _ => None,
    })
}

/// The blade of [`stroke`] at `t` ms, from 0 to [`STROKE_MS`].
fn blade_at(t: i64) -> [f64; 3] {
    [0.004 + 0.4e-3 * t as f64, 0.0241, 0.018]
}

const STROKE_MS: i64 = 90;

fn stroke() -> RequestKind {
    let point = |i: i64| TimedBladePoint {
        time: ms(10 * i),
        blade: BladePoint {
            tip_m: blade_at(10 * i),
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.03,
        },
    };
    RequestKind::Cut(CutRequest::whole(
        (0..=STROKE_MS / 10).map(point).collect(),
        0.0,
    ))
}

/// The motion of [`stroke`], so much higher.
fn drawing(above_m: f64) -> PeerEvent {
    let sample = |t: i64| {
        let [x, y, z] = blade_at(t);
        ToolSample {
            time: ms(t),
            pose: Pose {
                position_m: [x, y, z + above_m],
                ..Pose::IDENTITY
            },
            buttons: 1,
            force_n: None,
        }
    };
    let samples = (0..=STROKE_MS).map(sample).collect();
    PeerEvent::Motion(PeerMotion::on_time(samples, ms(STROKE_MS)))
}

#[test]
fn wrong_grant_duplicate_name_and_full_session_are_refused() {
    let mut room = room(1);
    let bad = PeerEvent::Hello(Hello {
        name: "eve".into(),
        role: Role::Trainee,
        grant: SPECTATOR,
        tool: None,
        subscription: Subscription::Full,
        resume: None,
    });
    room.handle_event(PeerKey(1), bad, ms(0));
    assert!(matches!(
        refusal(&drain(&mut room)),
        Some(RefusalReason::BadGrant { .. })
    ));
    room.handle_event(
        PeerKey(2),
        hello("ann", Role::Trainee, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(
        PeerKey(3),
        hello("ann", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    assert!(matches!(
        refusal(&drain(&mut room)),
        Some(RefusalReason::NameTaken { .. })
    ));
    room.handle_event(
        PeerKey(4),
        hello("bob", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(
        PeerKey(5),
        hello("cid", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(
        PeerKey(6),
        hello("dan", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    assert!(matches!(
        refusal(&drain(&mut room)),
        Some(RefusalReason::Full { seats: 3, .. })
    ));
    assert_eq!((room.participant_count(), room.refused_count()), (3, 3));
}

#[test]
fn scripts_start_once_after_samples_of_all_tools() {
    let mut room = room(2);
    let started = |outputs: &[Output], to| {
        let ops = operations(outputs, PeerKey(to));
        ops.iter()
            .filter(|o| matches!(o.kind, OperationKind::Started { .. }))
            .count()
    };
    room.handle_event(
        PeerKey(1),
        hello("ann", Role::Trainee, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(
        PeerKey(2),
        hello("bob", Role::Trainee, ToolKind::Probe),
        ms(10),
    );
    room.handle_event(PeerKey(1), pressing(10, 14), ms(20));
    assert_eq!(started(&drain(&mut room), 1), 0, "bob is not ready");
    room.handle_event(PeerKey(2), pressing(30, 34), ms(40));
    assert_eq!(started(&drain(&mut room), 1), 1);
    room.handle_event(PeerKey(2), pressing(34, 38), ms(44));
    room.handle_event(
        PeerKey(3),
        hello("cid", Role::Spectator, ToolKind::Probe),
        ms(50),
    );
    let outputs = drain(&mut room);
    assert_eq!(
        (started(&outputs, 1), started(&outputs, 3)),
        (0, 1),
        "a newcomer reads the log"
    );
}

#[test]
fn all_clients_receive_equal_operations_in_order_including_late_ones() {
    let mut room = room(1);
    room.handle_event(
        PeerKey(1),
        hello("ann", Role::Trainee, ToolKind::Scalpel),
        ms(0),
    );
    room.handle_event(
        PeerKey(2),
        hello("bob", Role::Spectator, ToolKind::Probe),
        ms(1),
    );
    room.handle_event(PeerKey(1), drawing(0.0), ms(STROKE_MS));
    let (before, hash_before) = room.topology();
    let request = Request {
        id: RequestId(0),
        kind: stroke(),
    };
    room.handle_event(PeerKey(1), PeerEvent::Request(request), ms(200));
    let outputs = drain(&mut room);
    let (after, hash_after) = room.topology();
    assert_eq!(after, before + 1);
    assert_ne!(hash_before, hash_after);
    assert!(room.boundary_closed());
    let (one, two) = (
        operations(&outputs, PeerKey(1)),
        operations(&outputs, PeerKey(2)),
    );
    assert_eq!(one, two, "both read the log from its beginning");
    room.handle_event(
        PeerKey(3),
        hello("cid", Role::Spectator, ToolKind::Probe),
        ms(300),
    );
    let late = operations(&drain(&mut room), PeerKey(3));
    let ids: Vec<u64> = late.iter().map(|o| o.id.0).collect();
    assert_eq!(ids, (0..late.len() as u64).collect::<Vec<_>>());
    let cut = late
        .iter()
        .find(|o| matches!(o.kind, OperationKind::Cut(_)))
        .unwrap();
    assert_eq!(
        (cut.topology_version_before, cut.topology_version_after),
        (before, after)
    );
    assert_eq!(cut.hash_after, hash_after);
}

#[test]
fn probe_may_not_cut_and_a_stroke_through_air_cuts_nothing() {
    let mut room = room(1);
    room.handle_event(
        PeerKey(1),
        hello("ann", Role::Trainee, ToolKind::Probe),
        ms(0),
    );
    drain(&mut room);
    let request = |kind| {
        PeerEvent::Request(Request {
            id: RequestId(5),
            kind,
        })
    };
    room.handle_event(PeerKey(1), request(stroke()), ms(200));
    let refused = |outputs: &[Output]| {
        outputs.iter().find_map(|o| match o {
            Output::Message(_, PeerMessage::RequestRefused(r)) => Some(r.reason.clone()),
            _ => None,
        })
    };
    assert_eq!(refused(&drain(&mut room)), Some(RequestRefusal::NotAllowed));
    let bob = hello("bob", Role::Trainee, ToolKind::Scalpel);
    room.handle_event(PeerKey(2), bob, ms(210));
    room.handle_event(PeerKey(2), drawing(0.5), ms(210));
    drain(&mut room);
    let RequestKind::Cut(mut air) = stroke() else {
        unreachable!()
    };
    for point in &mut air.points {
        point.blade.tip_m[2] += 0.5;
    }
    room.handle_event(PeerKey(2), request(RequestKind::Cut(air)), ms(220));
    let refusal = refused(&drain(&mut room));
    assert!(matches!(refusal, Some(RequestRefusal::CanNotCut(_))));
    assert_eq!(room.topology().0, 0);
    let wrong = RequestKind::TopologyReport {
        version: 0,
        hash: TopologyHash(1),
    };
    room.handle_event(PeerKey(1), request(wrong), ms(230));
    assert_eq!(
        refused(&drain(&mut room)),
        Some(RequestRefusal::TopologyDiffers)
    );
}

/// Samples of a tool that stands pressed 4 mm into the middle of the top, up to `until`.
fn pressing(from: i64, until: i64) -> PeerEvent {
    pressing_at(from, until, ms(until))
}

/// The same samples with a time of arrival.
fn pressing_at(from: i64, until: i64, arrived: ServerTime) -> PeerEvent {
    let sample = |t: i64| ToolSample {
        time: ms(t),
        pose: Pose {
            position_m: [0.024, 0.024, 0.032 + 0.004],
            ..Pose::default()
        },
        buttons: 0,
        force_n: None,
    };
    PeerEvent::Motion(PeerMotion::on_time(
        (from..until).map(sample).collect(),
        arrived,
    ))
}

#[test]
fn pressing_tool_is_relayed_deforms_tissue_and_leaves_with_its_owner() {
    let mut room = room(1);
    room.handle_event(
        PeerKey(1),
        hello("ann", Role::Trainee, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(
        PeerKey(2),
        hello("bob", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    drain(&mut room);
    let mut corrected = 0.0_f32;
    for step in 0..40 {
        let t = step * 20;
        room.handle_event(PeerKey(1), pressing(t, t + 20), ms(t + 20));
        room.handle_tick(ms(t + 21), &mut || false);
        for output in drain(&mut room) {
            match output {
                Output::Datagram(peer, PeerDatagram::Motion(_)) => assert_eq!(peer, PeerKey(2)),
                Output::Datagram(_, PeerDatagram::Corrections(c)) => {
                    corrected = c.nodes.iter().map(|n| -n.1[2]).fold(0.0, f32::max);
                }
                _ => {}
            }
        }
    }
    assert!(corrected > 0.001, "the top is pressed in by {corrected} m");
    let silent = CloseReason::Silent(Span::from_millis(2000));
    room.handle_event(PeerKey(1), PeerEvent::Closed(silent), ms(900));
    let left = operations(&drain(&mut room), PeerKey(2));
    assert!(matches!(
        left[..],
        [ref o] if matches!(o.kind, OperationKind::Disconnected { .. })
    ));
    let mut tools = 1;
    for step in 0..20 {
        if let Some(report) = room.handle_tick(ms(1000 + step * 20), &mut || false) {
            tools = report.tools;
        }
    }
    assert_eq!(tools, 0);
}
