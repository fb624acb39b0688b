//! Transitions of a seat and of its tool compared with the state document.

use palpate_protocol::control::Control;
use palpate_protocol::handshake::{Resume, SEAT_RETENTION, Subscription};
use palpate_protocol::request::DelayReport;
use palpate_protocol::{OperationId, ParticipantId, ProtocolError};

use super::controls::{ANN, Lesson, freeze, mute, resume_of};
use super::*;

const DOCUMENT: &str = include_str!("../../../../protocol/STATES.md");

const SEAT_STATES: [&str; 4] = ["Connected", "Demoted", "Disconnected", "Removed"];

const TOOL_STATES: [&str; 3] = ["Active", "Muted", "Frozen"];

const BOB: ParticipantId = ParticipantId(2);

/// Allowance of the delay estimate for an uplink without delay and a sample every 250 ms, ms.
const UPLINK_MS: i64 = 50;

fn seat() -> Resume {
    Resume {
        participant: ANN,
        token: ResumeToken([1; 16]),
        next_operation: OperationId(0),
        topology_version: 0,
        topology_hash: TopologyHash(0),
    }
}

fn resume_hello(resume: Resume) -> PeerEvent {
    let PeerEvent::Hello(hello) = hello("ann", Role::Trainee, ToolKind::Probe) else {
        unreachable!()
    };
    PeerEvent::Hello(Hello {
        subscription: Subscription::Full,
        resume: Some(resume),
        ..hello
    })
}

/// State of Ann's seat according to the log.
fn state_of(room: &mut SimulatedRoom, log: &mut Vec<Arc<Operation>>) -> &'static str {
    log.extend(operations(&drain(room), PeerKey(2)));
    let of_ann = |o: &Arc<Operation>| match &o.kind {
        OperationKind::Joined { participant, .. } | OperationKind::Reconnected { participant } => {
            (*participant == ANN).then_some("Connected")
        }
        OperationKind::Disconnected { participant } => {
            (*participant == ANN).then_some("Disconnected")
        }
        OperationKind::Left { participant, .. } => (*participant == ANN).then_some("Removed"),
        _ => None,
    };
    let is_demoted = |o: &Arc<Operation>| match o.kind {
        OperationKind::Demoted { participant, .. } => (participant == ANN).then_some(true),
        OperationKind::Restored { participant } => (participant == ANN).then_some(false),
        _ => None,
    };
    match log.iter().rev().find_map(of_ann).unwrap() {
        "Connected" if log.iter().rev().find_map(is_demoted) == Some(true) => "Demoted",
        other => other,
    }
}

/// Ann reports this delay requirement for some seconds, over a downlink that needs it. Returns the time at the end.
fn report_requirement(
    room: &mut SimulatedRoom,
    peer: PeerKey,
    wanted_ms: u32,
    from: i64,
    seconds: i64,
) -> i64 {
    let until = from + seconds * 1000;
    for t in (from..=until).step_by(250) {
        let report = DelayReport {
            wanted_us: wanted_ms * 1000,
            ..DelayReport::default()
        };
        let PeerEvent::Motion(motion) = pressing_at(t - 4, t, ms(t)) else {
            unreachable!()
        };
        let motion = PeerMotion {
            round_trip: Some(Span::from_millis(i64::from(wanted_ms) + UPLINK_MS)),
            ..motion
        };
        room.handle_event(peer, PeerEvent::Motion(motion), ms(t));
        room.handle_event(peer, PeerEvent::Delay(report), ms(t));
        room.handle_tick(ms(t), &mut || true);
    }
    until
}

fn run(from: &str, what: &str) -> &'static str {
    let cap_us = 400_000;
    let mode = CompensationMode::Adaptive { cap_us };
    let (mut room, mut log) = (room_with(3, 1, mode), Vec::new());
    let mut now = 0;
    let ann = hello("ann", Role::Trainee, ToolKind::Probe);
    let lost = || PeerEvent::Closed(CloseReason::ConnectionLost("a test".into()));
    room.handle_event(PeerKey(1), ann.clone(), ms(0));
    let bob = hello("bob", Role::Trainee, ToolKind::Probe);
    room.handle_event(PeerKey(2), bob, ms(0));
    match from {
        "Demoted" => now = report_requirement(&mut room, PeerKey(1), 600, 0, 4),
        "Disconnected" => {
            // Otherwise the seat gives way.
            if !what.ends_with("never took part") {
                room.handle_event(PeerKey(1), pressing(-60_010, -60_000), ms(-60_000));
            }
            room.handle_event(PeerKey(1), lost(), ms(0));
        }
        "Removed" => room.handle_event(PeerKey(1), PeerEvent::Closed(CloseReason::Left), ms(0)),
        _ => {}
    }
    assert_eq!(state_of(&mut room, &mut log), from);
    let closed = |reason| (PeerKey(1), PeerEvent::Closed(reason));
    let (peer, event) = match what {
        "it leaves" => closed(CloseReason::Left),
        "it violates the protocol" => closed(CloseReason::Violation(ProtocolError::NotPalpate {
            found: [0; 4],
        })),
        "the server removes it" => closed(CloseReason::Goodbye("a test".into())),
        "the connection is lost" => (PeerKey(1), lost()),
        "silence" => closed(CloseReason::Silent(Span::from_millis(2000))),
        "it reconnects" => (PeerKey(3), resume_hello(seat())),
        "a wrong token" => {
            let token = ResumeToken([2; 16]);
            (PeerKey(3), resume_hello(Resume { token, ..seat() }))
        }
        "a new participant with its name" => (PeerKey(3), ann),
        "a new participant with its name, and it never took part" => {
            room.handle_event(PeerKey(3), ann, ms(now));
            let ops = operations(&drain(&mut room), PeerKey(2));
            let left = |o: &Arc<Operation>| matches!(o.kind, OperationKind::Left { participant, .. } if participant == ANN);
            return if ops.iter().any(left) {
                "Removed"
            } else {
                "Disconnected"
            };
        }
        "its requirement exceeds the cap for 2 s" | "its requirement exceeds the cap for 4 s" => {
            let seconds = if what.ends_with("2 s") { 2 } else { 4 };
            report_requirement(&mut room, PeerKey(1), 600, now, seconds);
            return state_of(&mut room, &mut log);
        }
        "its network has recovered for 8 s" | "its network has recovered for 11 s" => {
            let seconds = if what.ends_with(" 8 s") { 8 } else { 11 };
            report_requirement(&mut room, PeerKey(1), 50, now, seconds);
            return state_of(&mut room, &mut log);
        }
        "it requests a cut" => {
            let id = RequestId(1);
            let kind = stroke();
            (PeerKey(1), PeerEvent::Request(Request { id, kind }))
        }
        "59 s pass" | "60 s pass" => {
            let short = Span::from_millis(if what == "59 s pass" { 1000 } else { 0 });
            room.handle_tick(ms(0) + SEAT_RETENTION - short, &mut || true);
            return state_of(&mut room, &mut log);
        }
        other => panic!("no test for \"{other}\" of a seat"),
    };
    room.handle_event(peer, event, ms(now));
    state_of(&mut room, &mut log)
}

/// State of Bob's tool according to the answer to a cut.
fn tool_state(lesson: &mut Lesson) -> &'static str {
    match lesson.request(2, stroke()) {
        Err(RequestRefusal::Muted) => "Muted",
        Err(RequestRefusal::Frozen) => "Frozen",
        _ => "Active",
    }
}

fn run_tool(from: &str, what: &str) -> &'static str {
    let mut lesson = Lesson::new();
    match from {
        "Muted" => lesson.control(mute(BOB, true)).unwrap(),
        "Frozen" => lesson.control(freeze(true)).unwrap(),
        _ => {}
    }
    assert_eq!(tool_state(&mut lesson), from);
    let resume = match what {
        "it reconnects" => Some(Some(resume_of(BOB))),
        "it leaves and joins again" => Some(None),
        _ => None,
    };
    if let Some(resume) = resume {
        let lost = CloseReason::ConnectionLost("a test".into());
        let reason = resume.as_ref().map_or(CloseReason::Left, |_| lost);
        lesson.event(2, PeerEvent::Closed(reason));
        assert_eq!(lesson.join_with(2, "bob", Role::Trainee, resume), None);
        return tool_state(&mut lesson);
    }
    let hand_over = |participant| Control::HandOver { participant };
    let control = match what {
        "the instructor mutes it" => mute(BOB, true),
        "the instructor unmutes it" => mute(BOB, false),
        "the instructor hands the tool over to it" => hand_over(BOB),
        "the instructor hands the tool over to another participant" => hand_over(ANN),
        "the instructor freezes the session" => freeze(true),
        "the instructor continues the session" => freeze(false),
        other => panic!("no test for \"{other}\" of a tool"),
    };
    lesson.control(control).unwrap();
    tool_state(&mut lesson)
}

#[test]
fn seat_transitions_match_the_state_document() {
    check("Seat", &SEAT_STATES, run);
}

#[test]
fn tool_transitions_match_the_state_document() {
    check("Tool", &TOOL_STATES, run_tool);
}

fn check(heading: &str, states: &[&str], run: impl Fn(&str, &str) -> &'static str) {
    let section = DOCUMENT.split(&format!("## {heading}\n")).nth(1).unwrap();
    let section = section.split("\n## ").next().unwrap();
    let lines = section.lines().filter(|l| l.starts_with('|')).skip(2);
    let rows: Vec<Vec<&str>> = lines
        .map(|l| l.split('|').map(str::trim).collect())
        .collect();
    for state in states {
        assert!(rows.iter().any(|r| r[1] == *state), "{state} is missing");
        assert!(
            rows.iter().any(|r| r[3] == *state),
            "no transition leads to {state}"
        );
    }
    for row in &rows {
        assert!(states.contains(&row[1]), "there is no state {}", row[1]);
        assert_eq!(run(row[1], row[2]), row[3], "{}, {}", row[1], row[2]);
    }
}
