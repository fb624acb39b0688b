use palpate_protocol::handshake::{SnapshotInfo, Subscription};
use palpate_protocol::operation::{CompensationMode, CompensationSettings, CutStroke};
use palpate_protocol::request::CutRequest;
use palpate_protocol::{
    Epoch, Grant, ModelHash, ModelInfo, ParticipantId, ResumeToken, Role, ServerTime,
};

use super::*;
use crate::test_support::check_transitions;

const STATES: [&str; 4] = ["Connected", "Waiting", "Connecting", "Ended"];

const PATIENCE: Span = Span::from_millis(60_000);

const SEED: u64 = 7;

/// Longer than the first wait of any seed, ms.
const FIRST_WAIT_IS_OVER: i64 = 375;

fn at(ms: i64) -> ClientTime {
    ClientTime::from_micros(ms * 1000)
}

/// A welcome to a log of six operations, from the operation `first` on.
fn welcome(first: u64) -> Box<Welcome> {
    Box::new(Welcome {
        participant: ParticipantId(1),
        epoch: Epoch(1),
        role: Role::Trainee,
        server_time: ServerTime::ZERO,
        model: ModelInfo {
            hash: ModelHash(0),
            bytes: 0,
        },
        roster: Vec::new(),
        topology_version: 0,
        topology_hash: TopologyHash(0),
        first_operation: OperationId(first),
        snapshot: None,
        operations_so_far: 6,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: 0,
        },
        tick_hz: 60,
        session_started_at: None,
        resume_token: ResumeToken([0; 16]),
    })
}

/// A connected machine that has five operations of the log.
fn connected() -> Reconnector {
    connected_as(Role::Trainee)
}

fn connected_as(role: Role) -> Reconnector {
    let hello = Hello {
        name: "ann".to_owned(),
        role,
        grant: Grant([0; 16]),
        tool: None,
        subscription: Subscription::Full,
        resume: None,
    };
    Reconnector::new(hello, &welcome(5), PATIENCE, 0, SEED)
}

/// A machine of this role in its first attempt to reconnect.
fn connecting_as(role: Role) -> Reconnector {
    let mut machine = connected_as(role);
    machine.handle_lost("a test".to_owned(), at(0));
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    assert_eq!(state_of(&machine), "Connecting");
    machine
}

fn refusal(reason: RefusalReason) -> Refused {
    Refused::because(reason)
}

fn lost() -> Reconnector {
    let mut machine = connected();
    machine.handle_lost("a test".to_owned(), at(0));
    machine
}

fn cut() -> RequestKind {
    RequestKind::Cut(CutRequest::whole(Vec::new(), 0.0))
}

/// The operation of a cut by this participant.
fn own_cut(id: u64) -> Operation {
    Operation {
        id: OperationId(id),
        at: ServerTime::ZERO,
        author: ParticipantId(1),
        topology_version_before: 0,
        topology_version_after: 1,
        hash_after: TopologyHash(0),
        kind: OperationKind::Cut(CutStroke {
            began: ServerTime::ZERO,
            joins: false,
            points: Vec::new(),
            width_m: 0.0,
        }),
    }
}

fn actions(machine: &mut Reconnector) -> Vec<Action> {
    std::iter::from_fn(|| machine.poll_action()).collect()
}

fn numbers_sent(machine: &mut Reconnector) -> Vec<u32> {
    let sent = |action| match action {
        Action::Send(request) => Some(request.id.0),
        _ => None,
    };
    actions(machine).into_iter().filter_map(sent).collect()
}

/// The position in the log that the next connection resumes at.
fn position_asked(machine: &mut Reconnector) -> Option<u64> {
    let asked = |action| match action {
        Action::Connect(hello, _) => Some(hello.resume.unwrap().next_operation.0),
        _ => None,
    };
    actions(machine).into_iter().find_map(asked)
}

fn state_of(machine: &Reconnector) -> &'static str {
    match &machine.state {
        State::Connected { .. } => "Connected",
        State::Away(outage) if outage.is_connecting => "Connecting",
        State::Away(_) => "Waiting",
        State::Ended => "Ended",
    }
}

fn run(from: &str, what: &str) -> &'static str {
    let mut machine = lost();
    match from {
        "Connected" => machine = connected(),
        "Connecting" if what.contains("spectator") => machine = connecting_as(Role::Spectator),
        "Connecting" => machine = connecting_as(Role::Trainee),
        _ => {}
    }
    assert_eq!(state_of(&machine), from);
    match what {
        "the connection is lost" => machine.handle_lost("a test".to_owned(), at(300)),
        "silence for 0.9 s more" | "silence for 1 s more" => {
            machine.handle_event(ClientEvent::LinkLost, at(300));
            machine.handle_timeout(at(if what.contains("0.9") { 1200 } else { 1300 }));
        }
        "packets again after silence" => {
            machine.handle_event(ClientEvent::LinkLost, at(300));
            machine.handle_event(ClientEvent::LinkRestored, at(400));
            machine.handle_timeout(at(2000));
        }
        "the replica differs" => machine.handle_resync("a test".to_owned(), at(300)),
        "a goodbye" => {
            let reason = CloseReason::Goodbye("a test".to_owned());
            machine.handle_event(ClientEvent::Closed(reason), at(300));
        }
        "the participant leaves" => machine.handle_leave(),
        "the delay passes" => machine.handle_timeout(at(FIRST_WAIT_IS_OVER)),
        "60 s pass" => machine.handle_timeout(at(60_000)),
        "a welcome" => machine.handle_welcome(welcome(5), at(400)),
        "a welcome to a part of the log after the replica differed" => {
            machine.handle_resync("a test".to_owned(), at(390));
            machine.handle_welcome(welcome(5), at(400));
        }
        "no answer for 4 s" => machine.handle_timeout(at(FIRST_WAIT_IS_OVER + 4000)),
        "the attempt fails" => machine.handle_failure("a test".to_owned(), at(400)),
        "a refusal for load" => {
            machine.handle_refusal(
                refusal(RefusalReason::Full {
                    role: Role::Trainee,
                    seats: 8,
                }),
                at(400),
            );
        }
        "the seat is gone" | "the seat of a spectator is gone" => {
            machine.handle_refusal(refusal(RefusalReason::NoSuchSeat), at(400));
        }
        "another refusal" => machine.handle_refusal(refusal(RefusalReason::Closing), at(400)),
        "another server" => machine.handle_dead_end("a test".to_owned()),
        other => panic!("no test for \"{other}\" of a reconnect"),
    }
    state_of(&machine)
}

#[test]
fn reconnect_transitions_match_documented_table() {
    check_transitions("Reconnect", &STATES, run);
}

#[test]
fn rejected_request_is_counted_and_takes_no_number() {
    let mut machine = connected();
    machine.handle_request(cut(), true);
    machine.handle_request(cut(), false);
    assert_eq!(machine.status().requests_lost, 1);
    machine.handle_request(cut(), true);
    assert_eq!(numbers_sent(&mut machine), [1, 2], "no number is skipped");
    machine.handle_lost("a test".to_owned(), at(0));
    machine.handle_request(cut(), true);
    assert_eq!(machine.status().requests_lost, 2);
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    machine.handle_welcome(welcome(5), at(400));
    assert_eq!(
        numbers_sent(&mut machine),
        [1, 2],
        "requests outlive their connection"
    );
}

#[test]
fn old_requests_are_lost_instead_of_repeated() {
    let mut machine = connected();
    machine.handle_request(cut(), true);
    machine.handle_lost("a test".to_owned(), at(0));
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    actions(&mut machine);
    machine.handle_welcome(welcome(5), at(10_001));
    assert!(numbers_sent(&mut machine).is_empty());
    machine.handle_event(ClientEvent::CaughtUp, at(10_002));
    assert_eq!(machine.status().requests_lost, 1);
}

#[test]
fn old_cut_that_the_missing_log_contains_is_not_lost() {
    let mut machine = connected();
    machine.handle_request(cut(), true);
    machine.handle_lost("a test".to_owned(), at(0));
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    machine.handle_welcome(welcome(5), at(10_001));
    machine.handle_request(cut(), true);
    machine.handle_event(ClientEvent::Operation(own_cut(5)), at(10_002));
    machine.handle_event(ClientEvent::CaughtUp, at(10_002));
    assert_eq!(machine.status().requests_lost, 0);
    // The later cut is still open: a short absence repeats it.
    machine.handle_lost("a test".to_owned(), at(10_100));
    machine.handle_timeout(at(10_100 + FIRST_WAIT_IS_OVER));
    actions(&mut machine);
    machine.handle_welcome(welcome(6), at(10_500));
    assert_eq!(numbers_sent(&mut machine), [2]);
}

#[test]
fn delays_between_attempts_double_until_patience_is_over() {
    let mut machine = lost();
    let mut nominal = 250_000;
    let mut now = at(0);
    while state_of(&machine) != "Ended" {
        let due = machine.poll_timeout().unwrap();
        let wait = (due - now).as_micros();
        assert!(wait >= nominal / 2 || due == at(60_000), "{wait}");
        assert!(wait < nominal * 3 / 2, "{wait}");
        (nominal, now) = ((2 * nominal).min(8_000_000), due);
        machine.handle_timeout(due);
        machine.handle_failure("unreachable".to_owned(), due);
    }
    assert_eq!(now, at(60_000));
    let all = actions(&mut machine);
    let Some(Action::Deliver(ClientEvent::Closed(reason))) = all.iter().nth_back(1) else {
        panic!("{all:?}");
    };
    assert_eq!(
        reason.to_string(),
        "the connection was lost: a test; reconnecting failed for 60 s: unreachable"
    );
    assert!(matches!(all.last(), Some(Action::End(Farewell::Open))));
}

#[test]
fn resync_asks_for_the_whole_log_once() {
    let mut machine = lost();
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    assert_eq!(position_asked(&mut machine), Some(5));
    machine.handle_resync("it drifts".to_owned(), at(390));
    machine.handle_welcome(welcome(5), at(400));
    assert_eq!(position_asked(&mut machine), Some(0));
    machine.handle_resync("it drifts".to_owned(), at(410));
    machine.handle_welcome(welcome(0), at(450));
    assert_eq!(state_of(&machine), "Connected");
    assert_eq!(position_asked(&mut machine), None);
}

#[test]
fn attempt_after_a_resync_without_connection_asks_for_the_whole_log() {
    let mut machine = lost();
    machine.handle_resync("it drifts".to_owned(), at(100));
    machine.handle_timeout(at(FIRST_WAIT_IS_OVER));
    assert_eq!(position_asked(&mut machine), Some(0));
    machine.handle_welcome(welcome(0), at(400));
    assert_eq!(state_of(&machine), "Connected");
}

#[test]
fn link_is_reported_lost_and_restored_once() {
    let mut machine = lost();
    for t in [400, 1500] {
        machine.handle_timeout(at(t));
        machine.handle_failure("unreachable".to_owned(), at(t));
    }
    machine.handle_timeout(at(5000));
    machine.handle_welcome(welcome(5), at(5100));
    let of_link = |action: &Action| match action {
        Action::Deliver(ClientEvent::LinkLost) => Some(false),
        Action::Deliver(ClientEvent::LinkRestored) => Some(true),
        _ => None,
    };
    let reported: Vec<bool> = actions(&mut machine).iter().filter_map(of_link).collect();
    assert_eq!(reported, [false, true]);
    assert_eq!(
        (machine.status().reconnects, machine.is_connected()),
        (1, true)
    );
}

#[test]
fn refusal_for_load_is_reported_until_the_next_attempt() {
    let mut machine = connecting_as(Role::Trainee);
    machine.handle_refusal(
        refusal(RefusalReason::Full {
            role: Role::Trainee,
            seats: 8,
        }),
        at(400),
    );
    let retry = machine.status().retry.clone().unwrap();
    assert!(retry.is_busy && retry.cause.contains("all 8 seats"));
    assert_eq!(retry.attempt, 2);
    let due = machine.poll_timeout().unwrap();
    assert_eq!(retry.wait, due - at(400));
    machine.handle_timeout(due);
    assert_eq!(machine.status().retry, None);
    assert_eq!(position_asked(&mut machine), Some(5), "the seat is kept");
}

#[test]
fn spectator_without_a_seat_joins_again_under_its_name() {
    let mut machine = connecting_as(Role::Spectator);
    actions(&mut machine);
    machine.handle_refusal(refusal(RefusalReason::NoSuchSeat), at(400));
    // An attempt that fails does not bring the old seat back.
    for failed in [false, true] {
        if failed {
            machine.handle_failure("unreachable".to_owned(), at(500));
            machine.handle_timeout(machine.poll_timeout().unwrap());
        }
        let all = actions(&mut machine);
        let connects = |action: &Action| match action {
            Action::Connect(hello, _) => Some(hello.name == "ann" && hello.resume.is_none()),
            _ => None,
        };
        assert_eq!(all.iter().find_map(connects), Some(true), "{all:?}");
    }
    let again = Welcome {
        participant: ParticipantId(9),
        resume_token: ResumeToken([1; 16]),
        ..*welcome(0)
    };
    machine.handle_welcome(Box::new(again), at(2000));
    assert_eq!(state_of(&machine), "Connected");
    let status = machine.status();
    assert_eq!(status.joined_again_as, Some(ParticipantId(9)));
    assert_eq!(status.reconnects, 1);
    // The next outage resumes the new seat.
    machine.handle_lost("a test".to_owned(), at(3000));
    machine.handle_timeout(at(3000 + FIRST_WAIT_IS_OVER));
    let resumed = |action| match action {
        Action::Connect(hello, _) => hello.resume,
        _ => None,
    };
    let seat = actions(&mut machine).into_iter().find_map(resumed).unwrap();
    assert_eq!(seat.participant, ParticipantId(9));
    assert!(seat.token.matches(&ResumeToken([1; 16])));
}

#[test]
fn spectator_ends_when_neither_its_seat_nor_its_session_exists() {
    let mut machine = connecting_as(Role::Spectator);
    machine.handle_refusal(refusal(RefusalReason::NoSuchSeat), at(400));
    let other = Welcome {
        epoch: Epoch(2),
        ..*welcome(0)
    };
    machine.handle_welcome(Box::new(other), at(500));
    assert_eq!(state_of(&machine), "Ended");
    let last = actions(&mut machine).pop();
    assert!(matches!(last, Some(Action::End(Farewell::Final))));

    let mut machine = connecting_as(Role::Spectator);
    for _ in 0..2 {
        machine.handle_refusal(refusal(RefusalReason::NoSuchSeat), at(400));
    }
    assert_eq!(state_of(&machine), "Ended", "one new attempt, not a loop");
}

#[test]
fn welcome_with_another_token_is_a_new_seat_and_one_of_another_session_ends() {
    let mut machine = connecting_as(Role::Spectator);
    let again = Welcome {
        participant: ParticipantId(1),
        resume_token: ResumeToken([1; 16]),
        ..*welcome(0)
    };
    machine.handle_welcome(Box::new(again), at(400));
    let seat = machine.status().joined_again_as;
    assert_eq!(seat, Some(ParticipantId(1)), "numbers are used again");

    let mut machine = connecting_as(Role::Spectator);
    let other = Welcome {
        epoch: Epoch(2),
        ..*welcome(0)
    };
    machine.handle_welcome(Box::new(other), at(400));
    assert_eq!(state_of(&machine), "Ended");
}

#[test]
fn log_before_a_snapshot_is_not_resumed() {
    let mut first = welcome(0);
    first.snapshot = Some(SnapshotInfo {
        bytes: 1,
        topology_version: 3,
    });
    let resumed_at = |id: u64, version: u32| {
        let mut machine = connecting_as(Role::Trainee);
        machine.handle_welcome(first.clone(), at(400));
        let operation = Operation {
            topology_version_after: version,
            ..own_cut(id)
        };
        machine.handle_event(ClientEvent::Operation(operation), at(500));
        actions(&mut machine);
        machine.handle_lost("a test".to_owned(), at(1000));
        machine.handle_timeout(at(1000 + FIRST_WAIT_IS_OVER));
        let hello = actions(&mut machine).into_iter().find_map(|a| match a {
            Action::Connect(hello, _) => Some(hello),
            _ => None,
        });
        hello.unwrap().resume.unwrap().next_operation
    };
    assert_eq!(resumed_at(4, 2), OperationId(0), "a part of the log");
    assert_eq!(resumed_at(7, 3), OperationId(8));
}
