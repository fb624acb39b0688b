//! Retention and resumption of seats.

use palpate_protocol::handshake::{Resume, SEAT_RETENTION, Subscription, Welcome};
use palpate_protocol::{OperationId, ParticipantId, TopologyHash};

use super::*;

fn lost() -> PeerEvent {
    PeerEvent::Closed(CloseReason::ConnectionLost("a test".into()))
}

fn welcome(outputs: &[Output], to: PeerKey) -> Welcome {
    let mut welcomes = outputs.iter().filter_map(|o| match o {
        Output::Message(peer, PeerMessage::Welcome(w)) if *peer == to => Some(w.as_ref().clone()),
        _ => None,
    });
    welcomes.next().expect("a welcome")
}

/// State of the participant at `peer` after all messages sent to it.
fn seat_of(outputs: &[Output], peer: PeerKey, before: Option<Resume>) -> Resume {
    let mut seat = Resume::after_welcome(&welcome(outputs, peer), before);
    for operation in operations(outputs, peer) {
        assert_eq!(operation.id, seat.next_operation, "no hole in the log");
        seat.note(&operation);
    }
    seat
}

fn back(name: &str, resume: Resume) -> PeerEvent {
    let PeerEvent::Hello(hello) = hello(name, Role::Trainee, ToolKind::Scalpel) else {
        unreachable!()
    };
    PeerEvent::Hello(Hello {
        subscription: Subscription::Full,
        resume: Some(resume),
        ..hello
    })
}

fn probe_back(resume: Resume) -> PeerEvent {
    let PeerEvent::Hello(hello) = hello("ann", Role::Trainee, ToolKind::Probe) else {
        unreachable!()
    };
    PeerEvent::Hello(Hello {
        resume: Some(resume),
        ..hello
    })
}

/// A session with Ann and her blade at peer 1 and Bob at peer 2; Ann's seat.
fn two() -> (SimulatedRoom, Resume) {
    let mut room = room(1);
    let ann = hello("ann", Role::Trainee, ToolKind::Scalpel);
    room.handle_event(PeerKey(1), ann, ms(0));
    let bob = hello("bob", Role::Trainee, ToolKind::Probe);
    room.handle_event(PeerKey(2), bob, ms(0));
    room.handle_event(PeerKey(1), drawing(0.0), ms(STROKE_MS));
    let seat = seat_of(&drain(&mut room), PeerKey(1), None);
    (room, seat)
}

/// The same at 6 s, after Ann has taken part.
fn two_for_a_while() -> (SimulatedRoom, Resume) {
    let (mut room, mut seat) = two();
    room.handle_event(PeerKey(1), pressing(5990, 6000), ms(6000));
    for operation in operations(&drain(&mut room), PeerKey(1)) {
        seat.note(&operation);
    }
    (room, seat)
}

fn cut(room: &mut SimulatedRoom, peer: PeerKey, now: ServerTime) {
    cut_as(room, peer, 1, now);
}

fn cut_as(room: &mut SimulatedRoom, peer: PeerKey, id: u32, now: ServerTime) {
    let request = Request {
        id: RequestId(id),
        kind: stroke(),
    };
    room.handle_event(peer, PeerEvent::Request(request), now);
}

#[test]
fn reconnect_keeps_id_role_and_tool_and_sends_the_missing_log() {
    let (mut room, mut seat) = two();
    cut(&mut room, PeerKey(1), ms(200));
    for operation in operations(&drain(&mut room), PeerKey(1)) {
        seat.note(&operation);
    }
    room.handle_event(PeerKey(1), lost(), ms(1000));
    let to_bob = operations(&drain(&mut room), PeerKey(2));
    assert!(
        matches!(to_bob[..], [ref o] if o.kind == OperationKind::Disconnected { participant: ParticipantId(1) })
    );
    room.handle_event(PeerKey(3), back("ann", seat), ms(31_000));
    let outputs = drain(&mut room);
    let again = welcome(&outputs, PeerKey(3));
    assert_eq!(again.participant, ParticipantId(1));
    assert_eq!(again.role, Role::Trainee);
    assert_eq!(again.first_operation, seat.next_operation);
    assert!(again.resume_token.matches(&seat.token));
    let me = again.roster.iter().find(|e| e.name == "ann").unwrap();
    assert_eq!(me.tool.map(|t| t.kind), Some(ToolKind::Scalpel));
    let later = seat_of(&outputs, PeerKey(3), Some(seat));
    assert_eq!(
        later.next_operation.0 as usize,
        room.operation_count(),
        "all missed operations and the resumption"
    );
    let to_bob = operations(&outputs, PeerKey(2));
    assert!(
        matches!(to_bob[..], [ref o] if o.kind == OperationKind::Reconnected { participant: ParticipantId(1) })
    );
    cut_as(&mut room, PeerKey(3), 2, ms(31_100));
    assert!(room.topology().0 >= 1, "the resumed seat cuts");
}

/// Ann with a probe that has pressed for 200 ms; her seat. Clients remove a tool in the view of the log time, and D is
/// 20 ms.
fn one_who_presses() -> (SimulatedRoom, Resume) {
    let mut room = room(1);
    let ann = hello("ann", Role::Trainee, ToolKind::Probe);
    room.handle_event(PeerKey(1), ann, ms(0));
    let seat = seat_of(&drain(&mut room), PeerKey(1), None);
    room.handle_event(PeerKey(1), pressing(0, 200), ms(200));
    let pressed = room.handle_tick(ms(200), &mut || false).unwrap();
    assert_eq!(pressed.tools, 1);
    (room, seat)
}

#[test]
fn disconnected_tool_presses_until_the_view_reaches_the_log_time() {
    let (mut room, _) = one_who_presses();
    room.handle_event(PeerKey(1), lost(), ms(210));
    let before = room.handle_tick(ms(220), &mut || false).unwrap();
    assert_eq!(before.tools, 1, "the view of 200 ms");
    let after = room.handle_tick(ms(240), &mut || false).unwrap();
    assert_eq!(after.tools, 0, "the view of 220 ms");
}

#[test]
fn tool_resumed_within_the_delay_leaves_earlier_views_unchanged() {
    let (mut room, seat) = one_who_presses();
    room.handle_event(PeerKey(1), lost(), ms(210));
    room.handle_event(PeerKey(3), probe_back(seat), ms(212));
    let before = room.handle_tick(ms(220), &mut || false).unwrap();
    assert_eq!(before.tools, 1, "the view of 200 ms");
    let away = room.handle_tick(ms(240), &mut || false).unwrap();
    assert_eq!(away.tools, 0, "no samples since the loss");
    room.handle_event(PeerKey(3), pressing(230, 250), ms(250));
    let again = room.handle_tick(ms(260), &mut || false).unwrap();
    assert_eq!(again.tools, 1);
}

#[test]
fn tool_keeps_pressing_over_a_replaced_connection() {
    let (mut room, seat) = one_who_presses();
    room.handle_event(PeerKey(3), probe_back(seat), ms(210));
    for t in [220, 240] {
        let report = room.handle_tick(ms(t), &mut || false).unwrap();
        assert_eq!(report.tools, 1, "the tool stays in use as at every client");
    }
}

#[test]
fn kept_seat_occupies_its_name_and_place_until_it_expires() {
    let (mut room, seat) = two_for_a_while();
    room.handle_event(PeerKey(1), lost(), ms(7000));
    drain(&mut room);
    let other = hello("ann", Role::Spectator, ToolKind::Probe);
    room.handle_event(PeerKey(3), other.clone(), ms(7100));
    let taken = refusal(&drain(&mut room));
    assert!(matches!(taken, Some(RefusalReason::NameTaken { .. })));
    assert_eq!(room.participant_count(), 2);
    let end = ms(7000) + SEAT_RETENTION;
    room.handle_tick(end, &mut || false);
    let left = operations(&drain(&mut room), PeerKey(2));
    assert!(matches!(
        left[..],
        [ref o] if matches!(o.kind, OperationKind::Left { reason: LeaveReason::Silent, .. })
    ));
    room.handle_event(PeerKey(4), back("ann", seat), end);
    assert_eq!(
        refusal(&drain(&mut room)),
        Some(RefusalReason::NoSuchSeat),
        "the seat has expired"
    );
    room.handle_event(PeerKey(5), other, end);
    assert_eq!(refusal(&drain(&mut room)), None, "the name is free");
}

#[test]
fn refusal_of_a_kept_name_states_the_remaining_time() {
    let (mut room, _) = two_for_a_while();
    let sentence = |room: &mut SimulatedRoom, at| {
        let eve = hello("ann", Role::Spectator, ToolKind::Probe);
        room.handle_event(PeerKey(3), eve, at);
        let outputs = drain(room);
        let said = outputs.iter().find_map(|o| match o {
            Output::Message(_, PeerMessage::Refused(r)) => Some(r.sentence.clone()),
            _ => None,
        });
        said.expect("a refusal")
    };
    let here = sentence(&mut room, ms(6500));
    assert!(here.contains("already in the session"), "{here}");
    room.handle_event(PeerKey(1), lost(), ms(47_000));
    let away = sentence(&mut room, ms(67_000));
    assert!(away.contains("\"ann\" is kept for another 40 s"), "{away}");
}

#[test]
fn restarted_client_resumes_its_seat_with_its_current_tool() {
    let (mut room, seat) = two();
    let fresh = Resume {
        next_operation: OperationId(0),
        topology_version: 0,
        topology_hash: TopologyHash(0),
        ..seat
    };
    // The server has not yet detected the end of the previous program.
    room.handle_event(PeerKey(3), probe_back(fresh), ms(500));
    let outputs = drain(&mut room);
    let again = welcome(&outputs, PeerKey(3));
    assert_eq!(
        (again.participant, again.first_operation),
        (ParticipantId(1), OperationId(0))
    );
    let goodbye = |o: &Output| matches!(o, Output::Message(PeerKey(1), PeerMessage::Goodbye(_)));
    assert!(outputs.iter().any(goodbye));
    let last = operations(&outputs, PeerKey(2)).pop().unwrap();
    assert!(matches!(
        last.kind,
        OperationKind::ToolChanged { participant: ParticipantId(1), tool } if tool.kind == ToolKind::Probe
    ));
    room.handle_event(PeerKey(1), lost(), ms(600));
    assert_eq!(
        room.participant_count(),
        2,
        "the end of the old connection has no effect"
    );
}

#[test]
fn expired_seat_is_refused_even_before_a_tick_gives_it_up() {
    let (mut room, seat) = two();
    room.handle_event(PeerKey(1), lost(), ms(1000));
    drain(&mut room);
    let end = ms(1000) + SEAT_RETENTION;
    room.handle_event(PeerKey(4), back("ann", seat), end);
    assert_eq!(refusal(&drain(&mut room)), Some(RefusalReason::NoSuchSeat));
}

#[test]
fn wrong_token_name_or_id_resumes_no_seat() {
    let (mut room, seat) = two();
    room.handle_event(PeerKey(1), lost(), ms(1000));
    drain(&mut room);
    let wrong = Resume {
        token: ResumeToken([99; 16]),
        ..seat
    };
    let other = Resume {
        participant: ParticipantId(2),
        ..seat
    };
    let nobody = Resume {
        participant: ParticipantId(77),
        ..seat
    };
    let guesses = [
        ("ann", wrong),
        ("bob", other),
        ("ann", nobody),
        ("eve", seat),
    ];
    for (peer, (name, resume)) in guesses.into_iter().enumerate() {
        room.handle_event(PeerKey(10 + peer as u64), back(name, resume), ms(1500));
        assert_eq!(
            refusal(&drain(&mut room)),
            Some(RefusalReason::NoSuchSeat),
            "{name} {resume:?}"
        );
    }
    room.handle_event(PeerKey(20), back("ann", seat), ms(1600));
    assert_eq!(
        refusal(&drain(&mut room)),
        None,
        "the right token still resumes"
    );
}

#[test]
fn new_connection_replaces_an_undetected_dead_one() {
    let (mut room, seat) = two();
    room.handle_event(PeerKey(3), back("ann", seat), ms(1500));
    let outputs = drain(&mut room);
    assert_eq!(welcome(&outputs, PeerKey(3)).participant, ParticipantId(1));
    let is_told = |o: &Output| matches!(o, Output::Message(PeerKey(1), PeerMessage::Goodbye(_)));
    assert!(outputs.iter().any(is_told), "the old connection is closed");
    // Further messages of the old connection, and its end, have no effect.
    let before = room.operation_count();
    cut(&mut room, PeerKey(1), ms(1600));
    room.handle_event(PeerKey(1), lost(), ms(1700));
    assert_eq!(room.operation_count(), before);
    cut(&mut room, PeerKey(3), ms(1800));
    assert_eq!(room.operation_count(), before + 1);
}

#[test]
fn no_seat_is_kept_after_leaving_or_a_violation() {
    let violation = palpate_protocol::ProtocolError::OutOfRange {
        what: "a test",
        detail: String::new(),
    };
    for reason in [CloseReason::Left, CloseReason::Violation(violation)] {
        let (mut room, seat) = two();
        room.handle_event(PeerKey(1), PeerEvent::Closed(reason), ms(1000));
        drain(&mut room);
        room.handle_event(PeerKey(3), back("ann", seat), ms(1100));
        assert_eq!(refusal(&drain(&mut room)), Some(RefusalReason::NoSuchSeat));
    }
}

#[test]
fn full_backlog_ends_the_seat_as_too_slow() {
    let (mut room, _) = two();
    let backlog = palpate_protocol::ProtocolError::Backlog { bytes: 2, limit: 1 };
    let closed = PeerEvent::Closed(CloseReason::Violation(backlog));
    room.handle_event(PeerKey(1), closed, ms(1000));
    let to_bob = operations(&drain(&mut room), PeerKey(2));
    assert_eq!(
        to_bob.last().map(|o| o.kind.clone()),
        Some(OperationKind::Left {
            participant: ParticipantId(1),
            reason: LeaveReason::TooSlow,
        })
    );
}

#[test]
fn client_with_a_different_log_receives_the_whole_log() {
    let (mut room, seat) = two();
    room.handle_event(PeerKey(1), lost(), ms(1000));
    drain(&mut room);
    let strangers = [
        Resume {
            topology_hash: TopologyHash(1),
            ..seat
        },
        Resume {
            topology_version: 7,
            ..seat
        },
        Resume {
            next_operation: OperationId(u64::MAX),
            ..seat
        },
    ];
    for (i, stranger) in strangers.into_iter().enumerate() {
        let peer = PeerKey(30 + i as u64);
        room.handle_event(peer, back("ann", stranger), ms(1100));
        let outputs = drain(&mut room);
        assert_eq!(welcome(&outputs, peer).first_operation, OperationId(0));
        let all = operations(&outputs, peer);
        assert_eq!(all.len(), room.operation_count());
    }
}

#[test]
fn resumptions_of_a_seat_are_limited_in_rate() {
    let (mut room, seat) = two();
    let mut resumed = 0;
    for i in 0..1000 {
        let peer = PeerKey(100 + i);
        room.handle_event(peer, back("ann", seat), ms(1000));
        match refusal(&drain(&mut room)) {
            None => resumed += 1,
            Some(reason) => assert_eq!(reason, RefusalReason::Busy),
        }
    }
    assert_eq!(resumed, 8);
    room.handle_event(PeerKey(2000), back("ann", seat), ms(6000));
    assert_eq!(refusal(&drain(&mut room)), None, "one more after 5 s");
}

#[test]
fn request_before_a_reconnect_is_executed_once_and_answered_again() {
    let (mut room, mut seat) = two();
    cut_as(&mut room, PeerKey(1), 1, ms(200));
    let before = room.operation_count();
    // A stroke along an existing cut.
    cut_as(&mut room, PeerKey(1), 2, ms(210));
    for operation in operations(&drain(&mut room), PeerKey(1)) {
        seat.note(&operation);
    }
    room.handle_event(PeerKey(1), lost(), ms(1000));
    room.handle_event(PeerKey(3), back("ann", seat), ms(1500));
    drain(&mut room);
    let gone_and_back = 2;
    cut_as(&mut room, PeerKey(3), 1, ms(1600));
    cut_as(&mut room, PeerKey(3), 2, ms(1600));
    let outputs = drain(&mut room);
    assert_eq!(room.operation_count(), before + gone_and_back);
    assert_eq!(room.repetition_count(), 2);
    let refused = outputs.iter().filter(|o| {
        matches!(o, Output::Message(PeerKey(3), PeerMessage::RequestRefused(r)) if r.id == RequestId(2))
    });
    assert_eq!(refused.count(), 1, "the refusal is repeated");
}
