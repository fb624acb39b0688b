//! Protocol violations of a peer in datagrams: each is counted by its kind and changes nothing, and the
//! session continues.

use super::tests::Pair;
use crate::datagram::{Acknowledgement, Body, Datagram, Header, Memory, Tag};
use crate::lateness::Lateness;
use crate::request::RequestKind;
use crate::session::{EVENTS_MAX, PeerEvent};
use crate::{
    Epoch, LocalSample, ParticipantId, Pose, ServerTime, Span, ToolSample, ToolTrack, TopologyHash,
};

/// An established session.
fn standing() -> Pair {
    let mut pair = Pair::new(3, 20_000, 0, 0.0);
    pair.join(0);
    pair.steps(500);
    pair
}

/// A heartbeat of a client with a given header.
fn heartbeat(epoch: Epoch, sequence: u32, acknowledged: Option<Acknowledgement>) -> Vec<u8> {
    let datagram = Datagram {
        header: Header {
            tag: Tag {
                epoch,
                stream: ParticipantId(5),
            },
            sequence,
            generated: ServerTime::ZERO,
            is_whole: true,
            acknowledged,
        },
        body: Body::Delays(Vec::new()),
    };
    datagram.encode(&mut Memory::default()).unwrap()
}

#[test]
fn acknowledgement_of_unsent_datagrams_is_counted_and_ignored() {
    let mut pair = standing();
    let before = pair.server.stats();
    let next = pair.client.stats(pair.client_now()).sent as u32 + 1;
    for (i, newest) in [20_000, 30_000, 0].into_iter().enumerate() {
        let claim = Acknowledgement {
            newest,
            bits: u32::MAX,
        };
        let bytes = heartbeat(Epoch(2), next + i as u32, Some(claim));
        let now = pair.server_now();
        pair.server.handle_datagram(&bytes, now);
    }
    let after = pair.server.stats();
    assert_eq!(after.noise.false_acknowledgement, 3);
    assert_eq!(after.acknowledged, before.acknowledged);
    pair.steps(500);
    assert!(!pair.server.is_closed() && !pair.client.is_closed());
    assert!(
        pair.server.stats().acknowledged > before.acknowledged,
        "true ones still count"
    );
}

#[test]
fn datagrams_of_an_earlier_epoch_are_counted_and_ignored() {
    let mut pair = standing();
    let events = pair.server_events.len();
    let received = pair.server.stats().received;
    for sequence in 1..=40 {
        let bytes = heartbeat(Epoch(1), sequence, None);
        let now = pair.server_now();
        pair.server.handle_datagram(&bytes, now);
    }
    let stats = pair.server.stats();
    assert_eq!((stats.noise.other_epoch, stats.received), (40, received));
    assert_eq!(pair.server_events.len(), events);
    pair.steps(3000);
    assert!(!pair.server.is_closed() && !pair.client.is_closed());
}

#[test]
fn replayed_datagrams_are_counted_as_duplicate_or_old() {
    let mut pair = standing();
    let now = pair.server_now();
    let first = heartbeat(Epoch(2), 100, None);
    let before = pair.server.stats().noise;
    for _ in 0..5 {
        pair.server.handle_datagram(&first, now);
    }
    let later = heartbeat(Epoch(2), 20_000, None);
    pair.server.handle_datagram(&later, now);
    pair.server.handle_datagram(&first, now);
    let noise = pair.server.stats().noise;
    assert_eq!(noise.duplicate - before.duplicate, 4);
    assert_eq!(noise.old - before.old, 1);
    assert!(!pair.server.is_closed());
}

#[test]
fn samples_seconds_old_are_counted_and_not_relayed() {
    let mut pair = standing();
    let now = pair.server_now();
    let next = pair.client.stats(pair.client_now()).sent as u32 + 1;
    let before = pair.server.stats().noise.old;
    for (i, age_s) in [0, 3, 7200].into_iter().enumerate() {
        let sample = ToolSample {
            time: now - Span::from_millis(1000 * age_s),
            ..ToolSample::default()
        };
        let datagram = Datagram {
            header: Header {
                tag: Tag {
                    epoch: Epoch(2),
                    stream: ParticipantId(5),
                },
                sequence: next + i as u32,
                generated: sample.time,
                is_whole: true,
                acknowledged: None,
            },
            body: Body::Motion(vec![ToolTrack {
                participant: ParticipantId(5),
                samples: vec![sample],
                late: Lateness::NONE,
            }]),
        };
        let bytes = datagram.encode(&mut Memory::default()).unwrap();
        pair.server.handle_datagram(&bytes, now);
    }
    let mut motion = 0;
    while let Some(event) = pair.server.poll_event() {
        motion += usize::from(matches!(event, PeerEvent::Motion(_)));
    }
    assert_eq!((motion, pair.server.stats().noise.old - before), (1, 2));
    assert!(!pair.server.is_closed());
}

#[test]
fn stalled_room_loses_motion_but_no_request_and_no_participant() {
    let mut pair = standing();
    let hash = TopologyHash(0);
    let report = RequestKind::TopologyReport { version: 0, hash };
    pair.client.request(report.clone()).unwrap();
    for _ in 0..EVENTS_MAX + 500 {
        pair.now_us += 4000;
        let (client, server) = (pair.client_now(), pair.server_now());
        for i in 0..4 {
            pair.client.send_motion(LocalSample {
                time: client - Span::from_millis(3 - i),
                pose: Pose::IDENTITY,
                ..LocalSample::default()
            });
        }
        while let Some(bytes) = pair.client.poll_datagram(client) {
            pair.server.handle_datagram(&bytes, server);
        }
        while let Some(bytes) = pair.client.poll_stream() {
            pair.server.handle_stream(&bytes, server);
        }
    }
    assert!(!pair.server.is_closed());
    let events: Vec<PeerEvent> = std::iter::from_fn(|| pair.server.poll_event()).collect();
    assert_eq!(events.len(), EVENTS_MAX);
    assert!(matches!(&events[0], PeerEvent::Request(r) if r.kind == report));
}
