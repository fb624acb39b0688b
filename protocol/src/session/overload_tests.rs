//! A client that sends more requests than it may, or takes less than it is sent, costs a bounded amount.

use std::sync::Arc;

use proptest::prelude::*;

use super::tests::{hello, operation_at, welcome};
use super::*;
use crate::codec::{FRAME_MAX_BYTES, FrameDecoder, encode_frame};
use crate::handshake::Preamble;
use crate::operation::{BladePoint, CutStroke, OperationKind, STROKE_MAX_POINTS};
use crate::request::{ClientMessage, RequestKind, ServerMessage};
use crate::{OperationId, RequestId, TopologyHash};

/// A peer that has joined at time zero.
fn joined() -> ServerPeer {
    let mut peer = ServerPeer::new(ServerTime::ZERO);
    peer.handle_stream(&Preamble::OURS.to_bytes(), ServerTime::ZERO);
    let hello = encode_frame(&ClientMessage::Hello(hello())).unwrap();
    peer.handle_stream(&hello, ServerTime::ZERO);
    let welcome = PeerMessage::Welcome(Box::new(welcome(0, 0)));
    peer.send(&welcome, ServerTime::ZERO).unwrap();
    while peer.poll_stream().is_some() {}
    while peer.poll_event().is_some() {}
    peer
}

fn request(id: u32) -> Vec<u8> {
    let hash = TopologyHash(0);
    let kind = RequestKind::TopologyReport { version: 0, hash };
    let id = RequestId(id);
    encode_frame(&ClientMessage::Request(Request { id, kind })).unwrap()
}

/// An operation of `points` points.
fn operation(id: u64, points: usize) -> PeerMessage {
    let blade = BladePoint {
        tip_m: [0.123; 3],
        axis: [0.0, 0.0, 1.0],
        depth_m: 0.03,
    };
    let kind = OperationKind::Cut(CutStroke {
        began: ServerTime::ZERO,
        joins: false,
        points: vec![blade; points],
        width_m: 0.001,
    });
    PeerMessage::Operation(Arc::new(Operation {
        id: OperationId(id),
        kind,
        ..operation_at(id)
    }))
}

/// The reason of the end, if the session is over.
fn ending(peer: &mut ServerPeer) -> Option<CloseReason> {
    std::iter::from_fn(|| peer.poll_event()).find_map(|event| match event {
        PeerEvent::Closed(reason) => Some(reason),
        _ => None,
    })
}

proptest! {
    #[test]
    fn any_schedule_of_requests_is_answered_within_both_rates(
        waits_us in prop::collection::vec(0..30_000_i64, 1..1500),
    ) {
        let mut peer = joined();
        let mut decoder = FrameDecoder::<ServerMessage>::new(FRAME_MAX_BYTES);
        let (mut now, mut accepted, mut refused) = (ServerTime::ZERO, 0.0, 0.0);
        let mut is_flood = false;
        for (i, wait) in waits_us.into_iter().enumerate() {
            now = now + Span::from_micros(wait);
            peer.handle_stream(&request(i as u32 + 1), now);
            while let Some(event) = peer.poll_event() {
                match event {
                    PeerEvent::Request(_) => accepted += 1.0,
                    PeerEvent::Closed(reason) => {
                        let error = CloseReason::Violation(ProtocolError::RequestFlood {
                            accepted: REQUESTS_PER_SECOND_MAX,
                            refused: REQUESTS_PER_SECOND_MAX,
                        });
                        prop_assert_eq!(reason, error);
                        is_flood = true;
                    }
                    other => prop_assert!(false, "{:?}", other),
                }
            }
            while let Some(bytes) = peer.poll_stream() {
                decoder.push(&bytes);
            }
            while let Some(message) = decoder.next().unwrap() {
                match message {
                    ServerMessage::RequestRefused(r) => {
                        prop_assert_eq!(r.reason, crate::request::RequestRefusal::TooMany);
                        refused += 1.0;
                    }
                    other => prop_assert!(is_flood, "{:?}", other),
                }
            }
            let by_rate = f64::from(REQUESTS_PER_SECOND_MAX) * now.as_secs_f64();
            prop_assert!(accepted <= by_rate + f64::from(REQUESTS_BURST_MAX));
            prop_assert!(refused <= by_rate + f64::from(REFUSALS_BURST_MAX));
            prop_assert_eq!(accepted + refused + f64::from(u8::from(is_flood)), i as f64 + 1.0);
            if is_flood {
                break;
            }
        }
    }

    #[test]
    fn cutting_client_is_not_refused_after_any_stalls_below_the_silence_of_a_peer(
        stalls_ms in prop::collection::vec((0..5000_i64, 0..2000_i64), 1..8),
    ) {
        let mut peer = joined();
        let mut stalls = stalls_ms.into_iter();
        let (mut from, mut until) = (0, 0);
        for id in 1..1000_u32 {
            // 40 parts of a stroke and 5 reports per second.
            let sent_ms = i64::from(id) * 1000 / 45;
            if sent_ms >= until && let Some((pause, length)) = stalls.next() {
                from = sent_ms + pause;
                until = from + length;
            }
            let arrives_ms = if sent_ms >= from { sent_ms.max(until) } else { sent_ms };
            peer.handle_stream(&request(id), ServerTime::from_micros(arrives_ms * 1000));
            prop_assert!(matches!(peer.poll_event(), Some(PeerEvent::Request(_))));
        }
    }

    #[test]
    fn peer_that_takes_a_frame_in_time_stays_and_one_that_takes_none_is_closed(
        waits_ms in prop::collection::vec(1..10_000_i64, 1..30),
    ) {
        let mut peer = joined();
        let mut now = ServerTime::ZERO;
        for id in 0..100 {
            peer.send(&operation(id, 1), now).unwrap();
        }
        let idle = |peer: &mut ServerPeer, time: Span, now: &mut ServerTime| {
            let end = *now + time;
            while !peer.is_closed() && *now < end {
                *now = peer.poll_timeout().unwrap().max(*now + Span::from_micros(1)).min(end);
                // It is not silent.
                peer.handle_stream(&[], *now);
                peer.handle_timeout(*now);
                while peer.poll_datagram(*now).is_some() {}
            }
        };
        for ms in waits_ms {
            idle(&mut peer, Span::from_millis(ms), &mut now);
            prop_assert!(!peer.is_closed());
            prop_assert!(peer.poll_stream().is_some());
        }
        let since = now;
        idle(&mut peer, Span::from_millis(30_000), &mut now);
        let stalled = CloseReason::Violation(ProtocolError::Stalled { waited: STREAM_STALL_MAX });
        prop_assert_eq!(ending(&mut peer), Some(stalled));
        prop_assert!((STREAM_STALL_MAX..=STREAM_STALL_MAX + STREAM_STALL_MAX).contains(&(now - since)));
    }
}

#[test]
fn client_within_the_rate_is_never_refused() {
    let mut peer = joined();
    for i in 1..=5000_u32 {
        let now = ServerTime::from_micros(i64::from(i) * 20_000);
        peer.handle_stream(&request(i), now);
        assert!(matches!(peer.poll_event(), Some(PeerEvent::Request(_))));
    }
    assert!(peer.poll_stream().is_none());
}

#[test]
fn stalled_stream_lets_datagrams_pass() {
    let mut peer = joined();
    for id in 0.. {
        if !peer.has_room() {
            break;
        }
        peer.send(&operation(id, STROKE_MAX_POINTS), ServerTime::ZERO)
            .unwrap();
    }
    let report = (ParticipantId(1), DelayReport::default());
    let delays = PeerDatagram::Delays(vec![report].into());
    peer.send_datagram(&delays, ServerTime::ZERO);
    assert!(peer.poll_datagram(ServerTime::ZERO).is_some());
}
