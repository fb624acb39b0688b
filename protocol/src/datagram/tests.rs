//! Laws of a datagram's codec for arbitrary bytes.

use proptest::prelude::*;

use super::*;
use crate::lateness::Lateness;
use crate::{Epoch, Pose, Span, ToolSample};

const TAG: Tag = Tag {
    epoch: Epoch(3),
    stream: ParticipantId(2),
};

fn header() -> Header {
    Header {
        tag: TAG,
        sequence: 77,
        generated: ServerTime::from_micros(9_000_000),
        is_whole: false,
        acknowledged: Some(Acknowledgement {
            newest: 12,
            bits: 0b1011,
        }),
    }
}

/// Encodes without a baseline.
fn encode(datagram: &Datagram) -> Result<Vec<u8>, ProtocolError> {
    datagram.encode(&mut Memory::default())
}

fn decode(bytes: &[u8]) -> Result<Datagram, ProtocolError> {
    let expected = Expected {
        tag: TAG,
        sequence: 70,
        generated: ServerTime::from_micros(8_900_000),
        sent: 13,
    };
    Datagram::decode(bytes, &expected, &mut Memory::default())
}

fn track(participant: u16, samples: i64, force: bool) -> ToolTrack {
    let sample = |i: i64| ToolSample {
        time: ServerTime::from_micros(8_990_000 + 1000 * i),
        pose: Pose {
            position_m: [0.1 + 1e-4 * i as f64, -0.2, 19.99],
            orientation: [0.1, -0.3, 0.2, 0.927_361_849_549_570_4],
        },
        buttons: i as u8,
        force_n: force.then_some([1.25, -3.5, 0.0]),
    };
    ToolTrack {
        participant: ParticipantId(participant),
        samples: (0..samples).map(sample).collect(),
        late: Lateness {
            newest: Span::from_millis(samples - 1),
            oldest: Span::from_millis(40 * samples),
        },
    }
}

fn nodes(n: u32) -> Vec<(u32, [f32; 3])> {
    (0..n)
        .map(|i| (i * 3, [1e-3 * i as f32, -2e-3, 0.0]))
        .collect()
}

/// One of each kind.
fn every_kind() -> Vec<Datagram> {
    let view_time = ServerTime::from_micros(8_999_000);
    let report = DelayReport {
        mean_us: 1,
        deviation_us: 2,
        wanted_us: u32::MAX,
    };
    let probe = Probe {
        id: 5,
        client_sent: ClientTime::from_micros(-3),
    };
    let reply = Reply {
        id: 5,
        client_sent: ClientTime::from_micros(-3),
        server_received: ServerTime::from_micros(8_999_000),
        server_sent: ServerTime::from_micros(8_999_100),
    };
    [
        Body::Motion(vec![track(1, 8, true), track(4, 1, false)]),
        Body::Corrections(Corrections {
            topology_version: 2,
            view_time,
            nodes: nodes(20),
        }),
        Body::Displacements(Displacements {
            step_um: 50,
            topology_version: 2,
            view_time,
            waiting: 1234,
            nodes: nodes(20),
        }),
        Body::Probe(probe),
        Body::Reply(reply),
        Body::Delays(vec![
            (ParticipantId(1), report),
            (ParticipantId(9), DelayReport::default()),
        ]),
        Body::Copy((5, vec![1, 2, 3])),
    ]
    .map(|body| Datagram {
        header: header(),
        body,
    })
    .to_vec()
}

#[test]
fn every_kind_round_trips_within_its_quantum() {
    for datagram in every_kind() {
        let bytes = encode(&datagram).unwrap();
        let back = decode(&bytes).unwrap();
        let mut header = datagram.header;
        if let Body::Motion(tracks) = &datagram.body {
            header.generated = tracks[0].samples.last().unwrap().time;
        }
        assert_eq!(back.header, header);
        // Encoding it again gives the same bits.
        assert_eq!(encode(&back).unwrap(), bytes);
    }
}

#[test]
fn every_truncation_is_an_error_or_a_valid_message() {
    for datagram in every_kind() {
        let bytes = encode(&datagram).unwrap();
        for len in 0..bytes.len() {
            check(&bytes[..len]);
            // The header is 9 bytes or more here; a truncated range code reads as zeros.
            if len < 9 {
                assert!(decode(&bytes[..len]).is_err(), "{len} of {}", bytes.len());
            }
        }
    }
}

#[test]
fn trailing_bytes_are_an_error() {
    // The message in a copy ends with its datagram.
    let is_copy = |d: &Datagram| matches!(d.body, Body::Copy(_));
    for datagram in every_kind().into_iter().filter(|d| !is_copy(d)) {
        let mut bytes = encode(&datagram).unwrap();
        bytes.push(0);
        let error = decode(&bytes).unwrap_err();
        assert!(
            matches!(error, ProtocolError::TrailingBytes { extra: 1, .. }),
            "{error}"
        );
    }
}

#[test]
fn flipped_bits_never_panic_or_decode_out_of_range() {
    for datagram in every_kind() {
        let good = encode(&datagram).unwrap();
        for bit in 0..good.len() * 8 {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            check(&bytes);
        }
    }
}

/// Decoded values are within the ranges of their types.
fn check(bytes: &[u8]) {
    let Ok(datagram) = decode(bytes) else {
        return;
    };
    match datagram.body {
        Body::Motion(tracks) => {
            for sample in tracks.iter().flat_map(|t| &t.samples) {
                let limit = POSITION_MAX_M + POSITION_STEP_M;
                assert!(sample.pose.position_m.iter().all(|x| x.abs() <= limit));
                let norm = sample.pose.orientation.iter().map(|c| c * c).sum::<f64>();
                assert!((norm - 1.0).abs() < 1e-9);
            }
            for t in &tracks {
                assert!(t.samples.is_sorted_by_key(|s| s.time));
                assert!((1..=TRACK_MAX_SAMPLES).contains(&t.samples.len()));
            }
        }
        Body::Corrections(c) => assert!(c.nodes.is_sorted_by(|a, b| a.0 < b.0)),
        Body::Displacements(d) => assert!(d.nodes.is_sorted_by(|a, b| a.0 < b.0)),
        Body::Probe(_) | Body::Reply(_) | Body::Delays(_) | Body::Copy(_) => {}
    }
}

#[test]
fn encoder_rejects_values_out_of_range() {
    let send = |f: fn(&mut ToolSample)| {
        let mut track = track(1, 1, false);
        f(&mut track.samples[0]);
        encode(&Datagram {
            header: header(),
            body: Body::Motion(vec![track]),
        })
    };
    assert!(send(|s| s.pose.position_m[0] = f64::NAN).is_err());
    assert!(send(|s| s.pose.position_m[1] = 20.1).is_err());
    assert!(send(|s| s.pose.orientation = [0.0; 4]).is_err());
    assert!(send(|s| s.pose.orientation = [f64::INFINITY; 4]).is_err());
    assert!(send(|_| {}).is_ok());
    // Two tools whose samples are an hour apart, without a baseline.
    let mut tracks = vec![track(1, 1, false), track(4, 1, false)];
    tracks[1].samples[0].time = tracks[1].samples[0].time - Span::from_millis(4_000_000);
    let both = Datagram {
        header: header(),
        body: Body::Motion(tracks),
    };
    assert!(encode(&both).is_err());
    let nobody = Datagram {
        header: header(),
        body: Body::Motion(Vec::new()),
    };
    assert!(encode(&nobody).is_err());
}

#[test]
fn corrections_of_any_length_split_into_datagrams() {
    let all = nodes(1000);
    let view_time = ServerTime::from_micros(8_999_000);
    let pieces = Corrections::pieces(7, view_time, &all);
    let mut back = Vec::new();
    for piece in pieces {
        let datagram = Datagram {
            header: header(),
            body: Body::Corrections(piece),
        };
        let bytes = encode(&datagram).unwrap();
        match decode(&bytes).unwrap().body {
            Body::Corrections(c) => back.extend(c.nodes),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(back.len(), all.len());
    for ((n, x), (m, y)) in all.iter().zip(&back) {
        assert_eq!(n, m);
        let saturated = x.map(|c| c.min(0.327_67));
        assert!(saturated.iter().zip(y).all(|(a, b)| (a - b).abs() < 6e-6));
    }
}

proptest! {
    #[test]
    fn no_noise_makes_the_decoder_panic(bytes in proptest::collection::vec(any::<u8>(), 0..1200), kind in 0_u8..8) {
        check(&bytes);
        let mut bytes = bytes;
        if let Some(first) = bytes.first_mut() {
            *first = kind;
        }
        check(&bytes);
    }

    #[test]
    fn positions_and_rotations_round_trip_within_their_quantum(
        x in -20.0_f64..20.0,
        axis in [-1.0_f64..1.0, -1.0_f64..1.0, -1.0_f64..1.0],
        angle in -3.2_f64..3.2,
    ) {
        let q = nalgebra::UnitQuaternion::from_scaled_axis(nalgebra::Vector3::from(axis) * angle);
        let orientation = [q.i, q.j, q.k, q.w];
        let sample = ToolSample {
            time: header().generated,
            pose: Pose { position_m: [x, -x, 0.0], orientation },
            ..ToolSample::default()
        };
        let track = ToolTrack { participant: ParticipantId(1), samples: vec![sample], late: Lateness::NONE };
        let bytes = encode(&Datagram { header: header(), body: Body::Motion(vec![track]) }).unwrap();
        let Body::Motion(tracks) = decode(&bytes).unwrap().body else {
            panic!("another kind");
        };
        let back = tracks[0].samples[0].pose;
        prop_assert!((back.position_m[0] - x).abs() <= 0.51 * POSITION_STEP_M);
        let [i, j, k, w] = back.orientation;
        let p = nalgebra::UnitQuaternion::new_normalize(nalgebra::Quaternion::new(w, i, j, k));
        prop_assert!(p.angle_to(&q) < 0.05_f64.to_radians());
    }
}
