//! Copies of requests and operations overtake a stream that waits for a lost packet.

use super::tests::{Pair, operation};
use crate::control::Control;
use crate::datagram::{Body, Datagram, Header, Memory, Tag};
use crate::operation::Operation;
use crate::request::{Request, RequestKind, RequestRefusal, RequestRefused};
use crate::session::{ClientEvent, PeerEvent, PeerMessage};
use crate::{Epoch, OperationId, ParticipantId, RequestId, ServerTime};

/// An established session over 20 ms, whose streams stand still for a second.
fn held_back() -> Pair {
    let mut pair = Pair::new(3, 20_000, 0, 0.0);
    pair.join(1);
    pair.steps(500);
    let until = pair.now_us + 1_000_000;
    (pair.up.stream_due, pair.down.stream_due) = (until, until);
    pair
}

fn requests(pair: &Pair) -> Vec<RequestId> {
    let ids = pair.server_events.iter().filter_map(|event| match event {
        PeerEvent::Request(Request { id, .. }) => Some(*id),
        _ => None,
    });
    ids.collect()
}

fn operations(pair: &Pair) -> Vec<OperationId> {
    let ids = pair.client_events.iter().filter_map(|event| match event {
        ClientEvent::Operation(Operation { id, .. }) => Some(*id),
        _ => None,
    });
    ids.collect()
}

#[test]
fn copies_overtake_a_stream_that_waits_and_arrive_once() {
    let mut pair = held_back();
    for _ in 0..3 {
        pair.client
            .request(RequestKind::Control(Control::Undo))
            .unwrap();
        pair.steps(5);
    }
    for id in 1..4 {
        pair.send(&operation(id));
        pair.steps(5);
    }
    pair.steps(50);
    let expected = [1, 2, 3].map(RequestId);
    assert_eq!(requests(&pair), expected);
    assert_eq!(operations(&pair), [0, 1, 2, 3].map(OperationId));
    pair.steps(2000);
    assert_eq!(requests(&pair), expected);
    assert_eq!(operations(&pair), [0, 1, 2, 3].map(OperationId));
    assert!(!pair.server.is_closed() && !pair.client.is_closed());
}

/// Datagrams that requests add to those of a client without them, per request.
fn copies_per_request(loss: f64) -> f64 {
    let mut pair = Pair::new(3, 20_000, 0, loss);
    pair.join(1);
    pair.steps(20_000);
    let mut sent = |requests: i64| {
        let before = pair.client.stats(pair.client_now()).sent;
        for _ in 0..requests {
            let undo = RequestKind::Control(Control::Undo);
            pair.client.request(undo).unwrap();
            pair.steps(50);
        }
        pair.steps(50 * (100 - requests));
        (pair.client.stats(pair.client_now()).sent - before) as f64
    };
    let idle = sent(0);
    (sent(100) - idle) / 100.0
}

#[test]
fn number_of_copies_follows_the_loss_of_the_link() {
    let per_request = [0.0, 0.02, 0.1].map(copies_per_request);
    assert_eq!(
        per_request.map(f64::round),
        [1.0, 2.0, 4.0],
        "{per_request:?}"
    );
}

#[test]
fn log_of_the_welcome_has_no_copies() {
    let mut pair = Pair::new(3, 20_000, 0, 0.0);
    pair.join(40);
    let before = pair.server.stats().sent;
    pair.steps(40);
    assert!(pair.server.stats().sent - before < 10);
    assert_eq!(operations(&pair).len(), 40);
}

#[test]
fn refusal_and_operation_keep_their_order() {
    let mut pair = held_back();
    let refused = RequestRefused {
        id: RequestId(1),
        reason: RequestRefusal::NothingCut,
    };
    pair.send(&PeerMessage::RequestRefused(refused.clone()));
    pair.send(&operation(1));
    pair.steps(50);
    let answers = &pair.client_events;
    let at = |is: &dyn Fn(&ClientEvent) -> bool| answers.iter().position(is).unwrap();
    let refusal = at(&|e| *e == ClientEvent::RequestRefused(refused.clone()));
    let cut = at(&|e| matches!(e, ClientEvent::Operation(o) if o.id == OperationId(1)));
    assert!(refusal < cut);
}

#[test]
fn copy_that_is_no_message_is_noise() {
    let mut pair = held_back();
    let datagram = Datagram {
        header: Header {
            tag: Tag {
                epoch: Epoch(2),
                stream: ParticipantId(5),
            },
            sequence: pair.client.stats(pair.client_now()).expected as u32 + 1,
            generated: ServerTime::ZERO,
            is_whole: true,
            acknowledged: None,
        },
        body: Body::Copy((1, vec![0xff; 9])),
    };
    let bytes = datagram.encode(&mut Memory::default()).unwrap();
    let now = pair.client_now();
    pair.client.handle_datagram(&bytes, now);
    pair.steps(1);
    assert!(!pair.client.is_closed());
    assert_eq!(pair.client.stats(now).noise.malformed, 1);
}
