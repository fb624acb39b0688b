use palpate_protocol::session::Picture;

use super::*;

fn joins(
    room: &mut SimulatedRoom,
    key: u64,
    role: Role,
    subscription: Subscription,
) -> Vec<Output> {
    let PeerEvent::Hello(hello) = hello(&format!("p{key}"), role, ToolKind::Scalpel) else {
        unreachable!()
    };
    let hello = Hello {
        subscription,
        ..hello
    };
    room.handle_event(PeerKey(key), PeerEvent::Hello(hello), ms(0));
    drain(room)
}

fn pictures(outputs: &[Output], to: u64) -> Vec<Arc<Picture>> {
    let to = PeerKey(to);
    let of = outputs.iter().filter_map(|o| match o {
        Output::Datagram(peer, PeerDatagram::Picture(p)) if *peer == to => Some(Arc::clone(p)),
        _ => None,
    });
    of.collect()
}

#[test]
fn thin_subscription_with_a_tool_is_refused_with_the_reason() {
    let mut room = room(1);
    let refused = joins(&mut room, 1, Role::Trainee, Subscription::Thin);
    let reason = refusal(&refused).unwrap();
    assert_eq!(
        reason,
        RefusalReason::ThinTool {
            role: Role::Trainee
        }
    );
    let sentence = reason.to_string();
    assert!(
        sentence.contains("trainee") && sentence.contains("full") && sentence.contains("spectator"),
        "{sentence}"
    );
    assert_eq!(room.participant_count(), 0);
    let let_in = joins(&mut room, 2, Role::Spectator, Subscription::Thin);
    assert!(refusal(&let_in).is_none());
}

#[test]
fn thin_client_receives_sixty_surfaces_per_second_and_no_corrections() {
    let mut room = room(1);
    joins(&mut room, 1, Role::Trainee, Subscription::Full);
    joins(&mut room, 2, Role::Spectator, Subscription::Thin);
    let mut outputs = Vec::new();
    for t in 0..2000 {
        room.handle_tick(ms(t), &mut || false);
        outputs.extend(drain(&mut room));
    }
    assert!(pictures(&outputs, 1).is_empty());
    let theirs = pictures(&outputs, 2);
    // This room ticks 50 times per second, which limits the pictures.
    assert!((97..=101).contains(&theirs.len()), "{}", theirs.len());
    assert!(theirs.windows(2).all(|w| w[0].view_time < w[1].view_time));
    let nodes = &theirs[0].nodes;
    // 13 x 13 x 9 nodes, 11 x 11 x 7 of them inside.
    assert_eq!(nodes.len(), 13 * 13 * 9 - 11 * 11 * 7);
    assert!(nodes.windows(2).all(|w| w[0] < w[1]));
}

#[test]
fn cut_faces_are_part_of_the_next_surface() {
    let mut room = room(1);
    joins(&mut room, 1, Role::Trainee, Subscription::Full);
    joins(&mut room, 2, Role::Spectator, Subscription::Thin);
    let mut seen = Vec::new();
    for t in 0..400 {
        if t == 200 {
            room.handle_event(PeerKey(1), drawing(0.0), ms(t));
            let kind = stroke();
            let id = RequestId(1);
            room.handle_event(PeerKey(1), PeerEvent::Request(Request { id, kind }), ms(t));
        }
        room.handle_tick(ms(t), &mut || false);
        seen.extend(pictures(&drain(&mut room), 2));
    }
    let (first, last) = (seen.first().unwrap(), seen.last().unwrap());
    assert_eq!((first.topology_version, last.topology_version), (0, 1));
    assert!(last.nodes.len() > first.nodes.len() + 20);
    assert!(
        first
            .nodes
            .iter()
            .all(|n| last.nodes.binary_search(n).is_ok())
    );
}
