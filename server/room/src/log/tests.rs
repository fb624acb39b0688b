//! Space and compaction of the log.

use palpate_protocol::codec::encode_frame;
use palpate_protocol::control::{ANNOTATION_MAX_BYTES, Annotation};
use palpate_protocol::examples::annotation;
use palpate_protocol::handshake::ROSTER_MAX;
use palpate_protocol::operation::{
    BladePoint, CutStroke, HeldTool, LeaveReason, STROKE_MAX_POINTS,
};
use palpate_protocol::request::ServerMessage;
use palpate_protocol::session::STREAM_BACKLOG_MAX_BYTES;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{Pose, Role};
use proptest::prelude::*;

use super::*;

fn at(s: i64) -> ServerTime {
    ServerTime::from_micros(s * 1_000_000)
}

fn add(log: &mut Log, second: i64, kind: OperationKind) -> u64 {
    log.push(Arc::new(Operation {
        id: log.next(),
        at: at(second),
        author: ParticipantId(u16::MAX),
        topology_version_before: u32::MAX,
        topology_version_after: u32::MAX,
        hash_after: TopologyHash(u64::MAX),
        kind,
    }))
}

fn stroke(points: usize) -> OperationKind {
    let blade = BladePoint {
        tip_m: [0.123; 3],
        axis: [0.0, 0.0, 1.0],
        depth_m: 0.03,
    };
    OperationKind::Cut(CutStroke {
        began: ServerTime::ZERO,
        joins: false,
        points: vec![blade; points],
        width_m: 0.001,
    })
}

fn joined(who: u16) -> OperationKind {
    OperationKind::Joined {
        participant: ParticipantId(who),
        name: "x".repeat(64),
        role: Role::Trainee,
        tool: Some(ToolDescription::scalpel(0.001, 0.02)),
    }
}

/// The bytes of the log on the wire.
fn bytes(log: &Log) -> usize {
    let frame =
        |o: &Arc<Operation>| encode_frame(&ServerMessage::Operation(o.as_ref().clone())).unwrap();
    log.since(OperationId(0))
        .iter()
        .map(|o| frame(o).len())
        .sum()
}

#[test]
fn full_log_of_longest_operations_fits_a_new_client() {
    for points in [2, STROKE_MAX_POINTS] {
        let mut log = Log::default();
        while log.takes_cut(0) {
            add(&mut log, 0, stroke(points));
        }
        assert!(log.len() > 400, "{} strokes", log.len());
        while log.takes_delay() {
            let change = OperationKind::Compensation {
                delay_us: u32::MAX,
                effective_at: at(i64::from(u32::MAX)),
            };
            add(&mut log, 0, change);
        }
        while log.takes_seat() {
            add(&mut log, 0, joined(u16::MAX));
        }
        // One burst of freezes with all tools, the rest annotations.
        let held = HeldTool {
            participant: ParticipantId(u16::MAX),
            pose: Pose::IDENTITY,
            buttons: 0,
        };
        let frozen = OperationKind::Frozen {
            is_frozen: true,
            held: vec![held; ROSTER_MAX],
        };
        for _ in 0..128 {
            add(&mut log, 0, frozen.clone());
        }
        let annotation = Annotation {
            text: "x".repeat(ANNOTATION_MAX_BYTES),
            ..annotation()
        };
        while log.takes_control() {
            add(&mut log, 0, OperationKind::Annotated(annotation.clone()));
        }
        while log.takes_return() {
            add(&mut log, 0, OperationKind::Undone);
        }
        let snapshot = SNAPSHOT_MAX_BYTES as usize;
        let pieces = snapshot / SNAPSHOT_PIECE_BYTES;
        assert!(log.len() + pieces <= 26_900, "{}", log.len());
        assert!(bytes(&log) + snapshot + FRAME_MAX_BYTES < STREAM_BACKLOG_MAX_BYTES);
    }
}

#[test]
fn newcomers_read_nothing_about_departed_participants() {
    let who = ParticipantId(7);
    let mut log = Log::default();
    add(&mut log, 0, joined(7));
    add(&mut log, 0, joined(8));
    add(
        &mut log,
        10,
        OperationKind::Disconnected { participant: who },
    );
    add(
        &mut log,
        11,
        OperationKind::Reconnected { participant: who },
    );
    add(&mut log, 20, stroke(2));
    add(
        &mut log,
        30,
        OperationKind::Disconnected { participant: who },
    );
    log.compact(at(90));
    assert_eq!(log.len(), 4, "the reconnect and its loss are dropped");
    assert_eq!(log.complete_from(), OperationId(4));
    let reason = LeaveReason::Silent;
    let left = OperationKind::Left {
        participant: who,
        reason,
    };
    add(&mut log, 91, left);
    log.compact(at(160));
    assert_eq!(
        log.len(),
        5,
        "a client may still resume without the last minute"
    );
    log.compact(at(162));
    let kept: Vec<u64> = log.since(OperationId(0)).iter().map(|o| o.id.0).collect();
    assert_eq!(kept, [1, 4], "the other participant and the cut");
    assert_eq!(log.next(), OperationId(7));
    assert_eq!(log.complete_from(), OperationId(7));
}

/// Appends a change that leads to a version, whose hash is its number.
fn change(log: &mut Log, second: i64, version: u32, kind: OperationKind) {
    log.push(Arc::new(Operation {
        id: log.next(),
        at: at(second),
        author: ParticipantId(1),
        topology_version_before: version - u32::from(kind.changes_topology()),
        topology_version_after: version,
        hash_after: TopologyHash(version.into()),
        kind,
    }));
}

fn numbers(operations: &[Arc<Operation>]) -> Vec<u64> {
    operations.iter().map(|o| o.id.0).collect()
}

#[test]
fn snapshot_replaces_the_changes_up_to_its_version() {
    let mut log = Log::default();
    change(&mut log, 0, 0, joined(1));
    change(&mut log, 0, 1, stroke(2));
    change(&mut log, 0, 1, joined(2));
    change(&mut log, 0, 2, OperationKind::Undone);
    change(&mut log, 90, 2, joined(3));
    change(&mut log, 90, 3, stroke(2));
    assert!(log.cover(2, &vec![5; SNAPSHOT_PIECE_BYTES + 1]));
    let (info, pieces) = log.snapshot().unwrap();
    assert_eq!(info.topology_version, 2);
    assert_eq!(info.bytes as usize, pieces.concat().len());
    assert_eq!(numbers(&log.for_newcomer()), [0, 2, 4, 5]);
    log.compact(at(60));
    assert_eq!(log.len(), 6, "a client that resumes continues its log");
    log.compact(at(100));
    assert_eq!(numbers(log.since(OperationId(0))), [0, 2, 4, 5]);
    assert_eq!(log.complete_from(), OperationId(4));
    let state = |number| log.state_before(OperationId(number));
    assert_eq!(state(4), Some((2, TopologyHash(2))), "of a dropped undo");
    assert_eq!(state(6), Some((3, TopologyHash(3))));
    assert_eq!(log.hash_of(3), Some(TopologyHash(3)));
    assert_eq!(log.hash_of(4), None);
}

#[test]
fn state_after_compaction_is_that_of_the_latest_dropped_change() {
    let mut log = Log::default();
    for version in 1..=4 {
        // The last blade is older than the one before it.
        let second = if version == 4 { 0 } else { 2 };
        change(&mut log, second, version, stroke(2));
    }
    assert!(log.cover(4, &[0; 100]));
    for second in 70..80 {
        log.compact(at(second));
    }
    assert_eq!(log.len(), 0);
    assert_eq!(
        log.dropped.map(|(after, (version, _))| (after.0, version)),
        Some((4, 4))
    );
}

#[test]
fn snapshots_keep_the_log_short_and_its_space_free() {
    let mut log = Log::default();
    let mut snapshots = 0;
    for version in 1..20_000 {
        assert!(log.takes_cut(0) && log.takes_return());
        let kind = match version % 3 {
            0 => OperationKind::Undone,
            _ => stroke(STROKE_MAX_POINTS),
        };
        change(&mut log, 0, version, kind);
        if log.poll_snapshot_due() {
            assert!(log.cover(version, &[0]));
            snapshots += 1;
            log.compact(at(snapshots));
        }
        let space = log
            .operations
            .iter()
            .map(|o| space_of(&o.kind))
            .sum::<u64>();
        let uncovered = SNAPSHOT_EVERY as u64 * space_of(&stroke(STROKE_MAX_POINTS));
        assert!(space <= COVERED_MAX_BYTES + uncovered, "{space}");
    }
    assert_eq!(snapshots, 19_999 / SNAPSHOT_EVERY as i64);
}

#[test]
fn snapshot_that_is_too_large_leaves_the_log_as_it_is() {
    let mut log = Log::default();
    let mut due = 0;
    let mut version = 0;
    while log.takes_cut(0) {
        version += 1;
        change(&mut log, 0, version, stroke(2));
        if log.poll_snapshot_due() {
            due += 1;
            assert!(!log.cover(version, &vec![0; SNAPSHOT_MAX_BYTES as usize + 1]));
        }
    }
    assert_eq!(due, version / SNAPSHOT_EVERY as u32, "once in a while");
    assert_eq!(log.for_newcomer().len(), version as usize);
    assert!(log.takes_return(), "a reset makes room");
    change(&mut log, 0, version + 1, OperationKind::Reset);
    assert!(log.poll_snapshot_due(), "the reset is covered at once");
    assert!(log.cover(version + 1, &[0]) && log.takes_cut(0));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    /// One author cuts as much as it may, also under new numbers.
    #[test]
    fn other_authors_still_cut_whatever_one_author_does(
        cuts in prop::collection::vec((1_usize..STROKE_MAX_POINTS, any::<bool>()), 1..50),
        others in 0_u64..2_000_000,
    ) {
        let mut log = Log::default();
        let (mut departed, mut used) = (0, 0);
        for (points, rejoins) in cuts.into_iter().cycle().take(8_000) {
            if rejoins {
                // A newcomer inherits the space of those who left.
                departed = used;
            }
            if log.takes_cut(used) {
                used += add(&mut log, 0, stroke(points));
            }
        }
        prop_assert!(departed <= used);
        prop_assert!(log.takes_cut(others), "{} used of the log", used);
    }

    #[test]
    fn churn_of_participants_keeps_the_log_short(
        steps in prop::collection::vec((0_u16..4, any::<bool>()), 1..100),
    ) {
        let mut log = Log::default();
        let mut who = 0;
        for (second, (joins, leaves)) in (0..4000).zip(steps.iter().cycle()) {
            for _ in 0..*joins {
                who += 1;
                add(&mut log, second, joined(who));
                if *leaves {
                    let reason = LeaveReason::Left;
                    add(&mut log, second, OperationKind::Left { participant: ParticipantId(who), reason });
                } else {
                    add(&mut log, second, OperationKind::Disconnected { participant: ParticipantId(who) });
                    add(&mut log, second, OperationKind::Left { participant: ParticipantId(who), reason: LeaveReason::Silent });
                }
            }
            log.compact(at(second));
        }
        prop_assert!(log.len() <= 72 * 4 * 3);
        prop_assert!(log.about_participants == log.len());
    }
}
