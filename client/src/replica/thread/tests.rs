use std::time::Duration;

use palpate_haptics::Touch;
use palpate_protocol::examples;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::ServerMessage;
use palpate_protocol::{OperationId, ParticipantId, ServerTime, TopologyHash};
use palpate_tissue::{Material, block};

use super::*;

/// The replica of a small block without a hand.
fn replica() -> ReplicaLoop {
    let model = Arc::new(block([2, 2, 2], 4e-3, &Material::default(), 1));
    let mut messages = examples::server_messages().into_iter();
    let welcome = messages.find_map(|e| match e.message {
        ServerMessage::Welcome(welcome) => Some(welcome),
        _ => None,
    });
    ReplicaLoop::new(Inputs {
        site: Site::new(&welcome.unwrap(), model, None),
        inbox: Arc::default(),
        commands: mpsc::channel(1).0,
        resync: mpsc::channel(1).0,
        hand: None,
        script: None,
        reach: None,
        record_every: None,
        recording: Recording::default(),
        page: None,
    })
}

#[cfg(not(windows))]
#[test]
fn operations_are_handled_while_the_budget_is_spent() {
    let mut replica = replica();
    let inbox = Arc::clone(&replica.inputs.inbox);
    inbox.read_here();
    let hash_after = TopologyHash(replica.inputs.site.replica().topology().hash().0);
    let network = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(5));
        let participant = ParticipantId(3);
        inbox.push(ClientEvent::LinkLost);
        // Operations wake the replica.
        inbox.push(ClientEvent::Operation(Operation {
            id: OperationId(0),
            at: ServerTime::ZERO,
            author: participant,
            topology_version_before: 0,
            topology_version_after: 0,
            hash_after,
            kind: OperationKind::Disconnected { participant },
        }));
    });
    replica.rest_until(monotonic_now() + Span::from_millis(1000));
    assert!(replica.link_lost && replica.ending.is_none());
    network.join().unwrap();
}

#[test]
fn contact_model_without_trust_has_no_force() {
    let mut model = ContactModel::single(Touch {
        touches: true,
        ..Touch::NONE
    });
    model.solved_at = ClientTime::from_micros(7);
    model.topology_version = 3;
    assert!(model.in_contact());
    remove_force(&mut model);
    assert!(!model.in_contact());
    assert_eq!(model.solved_at, ClientTime::from_micros(7));
    assert_eq!(model.topology_version, 3);
}
