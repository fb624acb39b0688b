//! Snapshots for newcomers: many cuts, then a join and resumptions.

use palpate_protocol::handshake::{Resume, SNAPSHOT_PIECE_BYTES, Welcome};
use palpate_protocol::session::CloseReason;
use palpate_protocol::{OperationId, ParticipantId};

use super::*;
use crate::room::Room;
use crate::{LoggedCut, TissueOrder, TissueReport};

const ANN: PeerKey = PeerKey(1);

/// Ann's session.
fn session() -> Room {
    let config = config(8, 1, CompensationMode::Fixed);
    let mut room = Room::new(TopologyHash(0), config, ms(0));
    room.handle_event(ANN, hello("ann", Role::Trainee, ToolKind::Scalpel), ms(0));
    room
}

/// Logs an undo that leads to a version, whose hash is its number. Returns whether a snapshot is due.
fn log_undo(room: &mut Room, version: u32) -> bool {
    let report = TissueReport::Cut {
        author: ParticipantId(1),
        request: RequestId(version),
        result: Ok(LoggedCut {
            change: OperationKind::Undone,
            version,
            hash: TopologyHash(version.into()),
            blade_at: None,
        }),
    };
    room.handle_report(report, ms(100));
    let orders = std::iter::from_fn(|| room.poll_order());
    orders
        .filter(|o| matches!(o, TissueOrder::Snapshot))
        .count()
        == 1
}

fn outputs(room: &mut Room) -> Vec<Output> {
    std::iter::from_fn(|| room.poll_output()).collect()
}

fn welcome(outputs: &[Output], to: PeerKey) -> Welcome {
    let welcome = outputs.iter().find_map(|o| match o {
        Output::Message(peer, PeerMessage::Welcome(w)) if *peer == to => Some(w),
        _ => None,
    });
    welcome.unwrap().as_ref().clone()
}

fn snapshot(outputs: &[Output], to: PeerKey) -> Vec<u8> {
    let pieces = outputs.iter().filter_map(|o| match o {
        Output::Message(peer, PeerMessage::Snapshot(piece)) if *peer == to => Some(piece),
        _ => None,
    });
    pieces.flat_map(|piece| piece.iter().copied()).collect()
}

#[test]
fn newcomer_receives_the_snapshot_and_resuming_client_the_rest_of_its_log() {
    let mut room = session();
    let due: Vec<u32> = (1..300).filter(|&v| log_undo(&mut room, v)).collect();
    assert_eq!(due, [64, 128, 192, 256], "once per interval");
    let ann = welcome(&outputs(&mut room), ANN);
    let bytes: Vec<u8> = (0..3 * SNAPSHOT_PIECE_BYTES / 2).map(|i| i as u8).collect();
    let report = TissueReport::Snapshot {
        version: 256,
        bytes: bytes.clone(),
    };
    room.handle_report(report, ms(200));
    let bob = PeerKey(2);
    room.handle_event(bob, hello("bob", Role::Spectator, ToolKind::Probe), ms(300));
    let sent = outputs(&mut room);
    let info = welcome(&sent, bob).snapshot.unwrap();
    assert_eq!(
        (info.bytes as usize, info.topology_version),
        (bytes.len(), 256)
    );
    assert_eq!(snapshot(&sent, bob), bytes);
    let log = operations(&sent, bob);
    let versions = log.iter().filter(|o| o.kind.changes_topology());
    let versions: Vec<u32> = versions.map(|o| o.topology_version_after).collect();
    assert_eq!(versions, (257..300).collect::<Vec<_>>());
    let so_far = welcome(&sent, bob).operations_so_far;
    assert!(log.iter().any(|o| o.id.0 + 1 == so_far));

    // Ann was away for a moment and lacks changes from before the snapshot.
    let lost = CloseReason::ConnectionLost("a test".into());
    room.handle_event(ANN, PeerEvent::Closed(lost), ms(400));
    outputs(&mut room);
    let resume = Resume {
        participant: ann.participant,
        token: ann.resume_token,
        next_operation: OperationId(101),
        topology_version: 100,
        topology_hash: TopologyHash(100),
    };
    let mut back = |peer: PeerKey, at: ServerTime| {
        let PeerEvent::Hello(hello) = hello("ann", Role::Trainee, ToolKind::Scalpel) else {
            unreachable!()
        };
        let resume = Some(resume);
        room.handle_event(peer, PeerEvent::Hello(Hello { resume, ..hello }), at);
        outputs(&mut room)
    };
    let sent = back(PeerKey(3), ms(500));
    assert_eq!(welcome(&sent, PeerKey(3)).first_operation, OperationId(101));
    assert_eq!(snapshot(&sent, PeerKey(3)), []);
    assert_eq!(operations(&sent, PeerKey(3))[0].topology_version_after, 101);
}

#[test]
fn continued_session_sends_its_snapshot_and_resumes_seats_with_it() {
    let config = config(8, 1, CompensationMode::Fixed);
    let mut room = Room::new(TopologyHash(9), config, ms(0));
    assert!(room.continue_from((5, TopologyHash(9)), &[1, 2, 3], ParticipantId(7)));
    room.handle_event(ANN, hello("ann", Role::Trainee, ToolKind::Scalpel), ms(0));
    let sent = outputs(&mut room);
    let first = welcome(&sent, ANN);
    assert_eq!(
        first.participant,
        ParticipantId(8),
        "others have cut before"
    );
    let state = (first.topology_version, first.topology_hash);
    assert_eq!(state, (5, TopologyHash(9)));
    assert_eq!(first.snapshot.unwrap().topology_version, 5);
    assert_eq!(snapshot(&sent, ANN), [1, 2, 3]);
    let mut seat = Resume::after_welcome(&first, None);
    for operation in operations(&sent, ANN) {
        seat.note(&operation);
    }
    let lost = CloseReason::ConnectionLost("a test".into());
    room.handle_event(ANN, PeerEvent::Closed(lost), ms(400));
    let PeerEvent::Hello(hello) = hello("ann", Role::Trainee, ToolKind::Scalpel) else {
        unreachable!()
    };
    let resume = Some(seat);
    let back = PeerKey(2);
    room.handle_event(back, PeerEvent::Hello(Hello { resume, ..hello }), ms(500));
    let sent = outputs(&mut room);
    assert_eq!(welcome(&sent, back).first_operation, seat.next_operation);
    assert_eq!(snapshot(&sent, back), []);
    log_undo(&mut room, 6);
    assert_eq!(room.topology(), (6, TopologyHash(6)));
}

#[test]
fn topology_reports_are_compared_as_far_as_the_log_goes() {
    let mut room = session();
    for version in 1..300 {
        log_undo(&mut room, version);
    }
    outputs(&mut room);
    let mut differs = |version: u32, hash: u64, id: u32| {
        let kind = RequestKind::TopologyReport {
            version,
            hash: TopologyHash(hash),
        };
        let request = PeerEvent::Request(Request {
            id: RequestId(id),
            kind,
        });
        room.handle_event(ANN, request, ms(200));
        let refused = outputs(&mut room);
        refused.iter().any(|o| {
            matches!(o, Output::Message(_, PeerMessage::RequestRefused(r))
                if r.reason == RequestRefusal::TopologyDiffers)
        })
    };
    assert!(!differs(299, 299, 1) && !differs(7, 7, 2));
    assert!(differs(299, 298, 3) && differs(7, 8, 4) && differs(300, 300, 5));
}
