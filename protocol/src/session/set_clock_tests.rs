//! A client whose clock is set by hours in the middle of a session.

use super::tests::Pair;
use super::*;
use crate::{LocalSample, Pose};

const HOURS_US: i64 = 3 * 3_600_000_000;

/// A session that has run for two seconds before its clock is set.
fn set_by(us: i64) -> Pair {
    let mut pair = Pair::new(1, 30_000, 5_000, 0.0);
    pair.join(0);
    moved(&mut pair, 2000);
    pair.set_us = us;
    pair.client_events.clear();
    pair.server_events.clear();
    pair
}

/// Runs for `ms` milliseconds with a hand at rest.
fn moved(pair: &mut Pair, ms: i64) {
    for _ in 0..ms {
        let time = pair.client_now();
        pair.client.send_motion(LocalSample {
            time,
            pose: Pose::IDENTITY,
            ..LocalSample::default()
        });
        pair.step();
    }
}

#[test]
fn clock_set_by_hours_locks_again_within_two_seconds() {
    for us in [-HOURS_US, HOURS_US] {
        let mut pair = set_by(us);
        moved(&mut pair, 2000);
        let map = pair.client.clock().expect("locked again");
        let error = (map.to_server(pair.client_now()) - pair.server_now()).abs();
        assert!(error <= map.error_bound(), "set by {us} µs: {error:?}");
        assert!(error <= Span::from_millis(50), "set by {us} µs: {error:?}");
    }
}

#[test]
fn motion_has_the_right_time_after_the_clock_is_set() {
    for us in [-HOURS_US, HOURS_US] {
        let mut pair = set_by(us);
        moved(&mut pair, 2000);
        pair.server_events.clear();
        moved(&mut pair, 1000);
        let mut batches = 0;
        for event in std::mem::take(&mut pair.server_events) {
            if let PeerEvent::Motion(motion) = event {
                let age =
                    pair.server_now() - motion.samples.last().expect("no batch is empty").time;
                assert!(
                    (Span::ZERO..=Span::from_millis(1100)).contains(&age),
                    "set by {us} µs: {age:?}"
                );
                batches += 1;
            }
        }
        assert!(batches > 200, "set by {us} µs: {batches} batches");
    }
}

#[test]
fn server_silence_is_detected_after_the_clock_is_set_back() {
    let mut pair = set_by(-HOURS_US);
    pair.steps(500);
    pair.down.loss = 1.0;
    pair.steps(1500);
    assert!(pair.client_events.contains(&ClientEvent::LinkLost));
}
