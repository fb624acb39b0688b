//! The room with asynchronous tissue: orders without a report yet.

use super::*;
use palpate_protocol::ParticipantId;
use palpate_protocol::session::PEER_SILENCE;
use palpate_protocol::tool::{part_id, part_owner};
use palpate_tissue::{Form, Needle, Tool, Vec3};

use crate::room::Room;
use crate::{Authority, LoggedCut, Settling, TissueOrder, TissueReport};

fn table() -> Room {
    let mut room = Room::new(
        TopologyHash(7),
        config(3, 0, CompensationMode::Fixed),
        ms(0),
    );
    room.handle_event(
        PeerKey(1),
        hello("ann", Role::Trainee, ToolKind::Scalpel),
        ms(0),
    );
    room.handle_event(
        PeerKey(2),
        hello("bob", Role::Spectator, ToolKind::Probe),
        ms(0),
    );
    room.handle_event(PeerKey(1), drawing(0.0), ms(0));
    drained(&mut room);
    room
}

fn drained(room: &mut Room) -> Vec<Output> {
    std::iter::from_fn(|| room.poll_output()).collect()
}

fn orders(room: &mut Room) -> Vec<TissueOrder> {
    std::iter::from_fn(|| room.poll_order()).collect()
}

fn asks_to_cut(room: &mut Room, id: u32, at: ServerTime) {
    let request = Request {
        id: RequestId(id),
        kind: stroke(),
    };
    room.handle_event(PeerKey(1), PeerEvent::Request(request), at);
}

fn refusals(outputs: &[Output]) -> Vec<RequestRefusal> {
    let of = outputs.iter().filter_map(|o| match o {
        Output::Message(_, PeerMessage::RequestRefused(r)) => Some(r.reason.clone()),
        _ => None,
    });
    of.collect()
}

#[test]
fn motion_is_relayed_while_the_tissue_is_busy() {
    let mut room = table();
    room.handle_tick(ms(0));
    asks_to_cut(&mut room, 1, ms(1));
    let waiting = orders(&mut room);
    assert!(matches!(
        waiting[..],
        [TissueOrder::Settle(_), TissueOrder::Cut(_)]
    ));
    // Neither order is completed for two seconds. Every 4 ms of motion still leave with the next round.
    let mut relayed = 0;
    for t in (104..2104).step_by(4) {
        room.handle_event(PeerKey(1), pressing(t - 4, t), ms(t));
        room.handle_tick(ms(t));
        let motion = |o: &Output| matches!(o, Output::Datagram(_, PeerDatagram::Motion(_)));
        relayed += drained(&mut room).iter().filter(|o| motion(o)).count();
    }
    assert!(relayed >= 490, "{relayed} datagrams in 2 s");
    assert!(orders(&mut room).is_empty(), "one tick at a time");
    // 50 ticks in a second, but the grid does not move before D is over.
    assert!(room.skipped_tick_count() >= 97);
}

#[test]
fn prepared_cut_enters_the_log_and_its_order_has_that_time() {
    let mut room = table();
    asks_to_cut(&mut room, 1, ms(100));
    let logged = LoggedCut {
        change: OperationKind::Cut(palpate_protocol::operation::CutStroke {
            began: ServerTime::ZERO,
            joins: false,
            points: Vec::new(),
            width_m: 0.0,
        }),
        version: 1,
        hash: TopologyHash(9),
        blade_at: None,
    };
    assert_eq!(room.topology(), (0, TopologyHash(7)));
    orders(&mut room);
    let report = TissueReport::Cut {
        author: ParticipantId(1),
        request: RequestId(1),
        result: Ok(logged),
    };
    room.handle_report(report, ms(250));
    assert_eq!(room.topology(), (1, TopologyHash(9)));
    let log = operations(&drained(&mut room), PeerKey(2));
    assert!(matches!(log[..], [ref o] if o.at == ms(250) && o.hash_after == TopologyHash(9)));
    let apply = orders(&mut room);
    assert!(
        matches!(apply[..], [TissueOrder::Apply { version: 1, at }] if at == ms(250)),
        "{apply:?}"
    );
}

#[test]
fn cut_takes_effect_with_its_blade_also_after_later_cuts() {
    let mut room = table();
    let mut effect_of = |version: u32, blade_ms: i64| {
        asks_to_cut(&mut room, version, ms(1000));
        orders(&mut room);
        let logged = LoggedCut {
            change: OperationKind::Undone,
            version,
            hash: TopologyHash(u64::from(version)),
            blade_at: Some(ms(blade_ms)),
        };
        let report = TissueReport::Cut {
            author: ParticipantId(1),
            request: RequestId(version),
            result: Ok(logged),
        };
        room.handle_report(report, ms(1000));
        let [TissueOrder::Apply { at, .. }] = orders(&mut room)[..] else {
            panic!("one order");
        };
        assert_eq!(operations(&drained(&mut room), PeerKey(2))[0].at, at);
        at
    };
    assert_eq!(effect_of(1, 930), ms(930));
    assert_eq!(effect_of(2, 910), ms(910), "a blade before the last one");
    assert_eq!(effect_of(3, 2000), ms(1000), "a future blade");
    assert_eq!(
        effect_of(4, -60_000),
        ms(1000) - PEER_SILENCE,
        "a repeated cut"
    );
}

#[test]
fn cuts_in_preparation_are_bounded_and_a_refusal_frees_a_slot() {
    let mut room = table();
    // The budget of length has filled.
    let now = ms(10_000);
    for id in 0..6 {
        asks_to_cut(&mut room, id, now);
    }
    assert_eq!(orders(&mut room).len(), 2, "in preparation at once");
    assert!(refusals(&drained(&mut room)).is_empty(), "the others wait");
    let report = TissueReport::Cut {
        author: ParticipantId(1),
        request: RequestId(0),
        result: Err(RequestRefusal::NothingCut),
    };
    room.handle_report(report, now);
    assert_eq!(refusals(&drained(&mut room)), [RequestRefusal::NothingCut]);
    assert!(orders(&mut room).is_empty());
    room.handle_report(prepared(Span::ZERO), now);
    assert_eq!(orders(&mut room).len(), 1);
    asks_to_cut(&mut room, 20, now);
    assert!(refusals(&drained(&mut room)).is_empty());
}

fn prepared(took: Span) -> TissueReport {
    let author = ParticipantId(1);
    TissueReport::Prepared { author, took }
}

#[test]
fn preparation_time_in_debt_is_paid_before_the_next_cut() {
    let mut room = table();
    asks_to_cut(&mut room, 1, ms(100));
    room.handle_report(prepared(Span::from_millis(1000)), ms(1100));
    drained(&mut room);
    // The debt is 0.25 s at most, and a quarter of a second is paid in one.
    asks_to_cut(&mut room, 2, ms(1200));
    assert_eq!(refusals(&drained(&mut room)), [RequestRefusal::TooMany]);
    asks_to_cut(&mut room, 3, ms(3200));
    assert!(refusals(&drained(&mut room)).is_empty());
}

#[test]
fn report_for_a_departed_author_is_sent_to_no_peer() {
    let mut room = table();
    asks_to_cut(&mut room, 1, ms(100));
    room.handle_event(PeerKey(1), PeerEvent::Closed(CloseReason::Left), ms(110));
    drained(&mut room);
    let report = TissueReport::Cut {
        author: ParticipantId(1),
        request: RequestId(1),
        result: Err(RequestRefusal::NothingCut),
    };
    room.handle_report(report, ms(120));
    assert!(refusals(&drained(&mut room)).is_empty());
}

/// A tick without tools.
fn settling(at: ServerTime) -> Settling {
    Settling {
        returns: false,
        view_time: at,
        tools: Vec::new(),
        blades: Vec::new(),
        wants_corrections: false,
        wants_picture: None,
    }
}

#[test]
fn cutting_blade_is_ordered_as_an_edge_and_presses_no_tissue() {
    let mut room = table();
    let mut edges = 0;
    for t in (0..400).step_by(16) {
        room.handle_tick(ms(t));
        for order in orders(&mut room) {
            if let TissueOrder::Settle(order) = order {
                edges += order.blades.len();
                assert!(order.blades.is_empty() || order.tools.is_empty());
                room.handle_report(controls::settled(), ms(t));
            }
        }
    }
    assert!(edges > 5, "{edges}");
}

#[test]
fn reaction_on_a_cutting_blade_is_toughness_times_depth_against_its_motion() {
    let (mut authority, _) = Authority::new(model());
    let mut along = |x: f64| {
        let blade = palpate_tissue::BladePoint {
            tip: Vec3::new(x, 0.0241, 0.022),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let order = Settling {
            blades: vec![(ParticipantId(1), blade)],
            ..settling(ms(0))
        };
        authority.settle(&order, &mut || false);
        authority.reactions()
    };
    assert!(along(0.019).is_empty(), "a resting blade");
    let [reaction] = &along(0.020)[..] else {
        panic!("one reaction")
    };
    // 100 J/m² over 10 mm.
    let off = reaction.force - Vec3::new(-1.0, 0.0, 0.0);
    assert!(off.norm() < 0.02, "{}", reaction.force);
    assert_eq!(part_owner(reaction.tool), ParticipantId(1));
    authority.settle(&settling(ms(20)), &mut || false);
    assert!(authority.reactions().is_empty());
}

#[test]
fn blade_that_follows_its_wound_has_no_reaction() {
    let (mut authority, mut cutter) = Authority::new(model());
    let RequestKind::Cut(cut) = stroke() else {
        unreachable!()
    };
    let along = |authority: &mut Authority, at: i64| {
        let follow = |point: &TimedBladePoint| {
            let blade = palpate_tissue::BladePoint {
                tip: point.blade.tip_m.into(),
                axis: point.blade.axis.into(),
                depth_m: point.blade.depth_m,
            };
            let order = Settling {
                blades: vec![(ParticipantId(1), blade)],
                ..settling(ms(at))
            };
            authority.settle(&order, &mut || false);
            let reactions = authority.reactions();
            reactions.iter().map(|r| r.force.norm()).sum::<f64>()
        };
        let forces: Vec<f64> = cut.points.iter().map(follow).collect();
        // Without the turn back before it, and the last half cell of the wound.
        forces[1..forces.len() - 2].iter().sum::<f64>()
    };
    let whole = along(&mut authority, 0);
    let job = authority.job(&crate::CutOrder {
        author: ParticipantId(1),
        request: RequestId(1),
        change: crate::RequestedChange::Cut(cut.clone()),
    });
    let made = cutter.make(&job).1;
    authority.take_cut(made.unwrap().finish());
    authority.apply(1, ms(100));
    let parted = along(&mut authority, 100);
    assert!(whole > 0.0 && parted == 0.0, "{parted} of {whole}");
}

#[test]
fn made_cut_is_the_one_that_replicas_read() {
    let (authority, mut cutter) = Authority::new(model());
    let RequestKind::Cut(mut cut) = stroke() else {
        unreachable!()
    };
    // A tip beyond the tissue has no rest position.
    cut.points[3].blade.tip_m[2] = -0.0213;
    cut.points[3].blade.depth_m = 0.0693;
    let job = authority.job(&crate::CutOrder {
        author: ParticipantId(1),
        request: RequestId(1),
        change: crate::RequestedChange::Cut(cut),
    });
    let (report, _) = cutter.make(&job);
    let TissueReport::Cut { result, .. } = report else {
        panic!("{report:?}")
    };
    let OperationKind::Cut(made) = result.unwrap().change else {
        panic!("no cut")
    };
    assert!(made.points.iter().all(|p| *p == p.rounded()));
}

#[test]
fn settled_tick_reports_the_holders_of_needles_that_enter() {
    let (mut authority, _) = Authority::new(model());
    let mut holders = |height: f64| {
        let needle = Tool {
            form: Form::line(Vec3::zeros(), Vec3::z() * 0.05),
            needle: Some(Needle {
                is_inserted: false,
                decides: false,
            }),
            ..Tool::ball(
                part_id(ParticipantId(2), 0),
                Vec3::new(0.0241, 0.0243, 0.032 + height),
                0.6e-3,
            )
        };
        let order = Settling {
            tools: vec![needle],
            ..settling(ms(0))
        };
        match authority.settle(&order, &mut || false) {
            TissueReport::Settled { inserted, .. } => inserted,
            _ => unreachable!(),
        }
    };
    assert_eq!(holders(5e-3), []);
    let mut entered = Vec::new();
    for step in 0..8 {
        entered = holders(-0.5e-3 * f64::from(step));
    }
    assert_eq!(entered, [ParticipantId(2)]);
}

/// Topology version of the surface at this view time.
fn version_seen(authority: &mut Authority, at: ServerTime) -> u32 {
    let order = Settling {
        wants_picture: Some(at),
        ..settling(at)
    };
    let TissueReport::Settled { picture, .. } = authority.settle(&order, &mut || false) else {
        unreachable!()
    };
    picture.unwrap().topology_version
}

#[test]
fn prepared_cut_takes_effect_in_the_first_view_of_its_time() {
    let (mut authority, mut cutter) = Authority::new(model());
    let RequestKind::Cut(cut) = stroke() else {
        unreachable!()
    };
    let job = authority.job(&crate::CutOrder {
        author: ParticipantId(1),
        request: RequestId(1),
        change: crate::RequestedChange::Cut(cut),
    });
    let (_, made) = cutter.make(&job);
    let prepared = made.map(palpate_tissue::TopologyCut::finish);
    authority.take_cut(prepared.unwrap());
    assert_eq!(
        version_seen(&mut authority, ms(100)),
        0,
        "not in the log yet"
    );
    authority.apply(1, ms(200));
    assert_eq!(version_seen(&mut authority, ms(180)), 0);
    assert_eq!(version_seen(&mut authority, ms(200)), 1);
}

#[test]
fn blade_that_moves_on_after_an_undo_begins_again() {
    let (authority, mut cutter) = Authority::new(model());
    let RequestKind::Cut(whole) = stroke() else {
        unreachable!()
    };
    let part = |from: usize, to: usize| {
        crate::RequestedChange::Cut(CutRequest {
            points: whole.points[from..=to].to_vec(),
            is_last: false,
            ..whole.clone()
        })
    };
    let mut cut = |from, to| match make(&authority, &mut cutter, part(from, to)) {
        Ok(OperationKind::Cut(cut)) => cut,
        other => panic!("{other:?}"),
    };
    let first = cut(0, 4);
    assert_eq!((first.joins, first.points.len()), (false, 5));
    let second = cut(4, 7);
    assert_eq!((second.joins, second.points.len()), (true, 3));
    assert_eq!(first.began, second.began);
    let undone = make(&authority, &mut cutter, crate::RequestedChange::Undo);
    assert_eq!(undone, Ok(OperationKind::Undone));
    let uncut = Authority::new(model()).1.hash();
    assert_eq!(cutter.hash(), uncut, "both parts are taken back");
    // The part before is not in effect any more.
    let Ok(OperationKind::Cut(third)) = make(&authority, &mut cutter, part(7, 9)) else {
        panic!("the third part cuts");
    };
    assert_eq!((third.joins, third.points.len()), (false, 3));
}

/// Prepares a change of participant 1.
fn make(
    authority: &Authority,
    cutter: &mut crate::Cutter,
    change: crate::RequestedChange,
) -> Result<OperationKind, RequestRefusal> {
    let job = authority.job(&crate::CutOrder {
        author: ParticipantId(1),
        request: RequestId(1),
        change,
    });
    let TissueReport::Cut { result, .. } = cutter.make(&job).0 else {
        unreachable!()
    };
    result.map(|logged| logged.change)
}
