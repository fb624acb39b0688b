//! A thin subscriber over a bad link: no drift, a bounded rate, and exact at rest.

use std::collections::BTreeMap;
use std::sync::Arc;

use proptest::prelude::*;

use super::*;
use crate::session::tests::Pair;
use crate::session::{ClientEvent, PeerDatagram};

/// Period of the pictures, ms: 62.5 a second.
const PERIOD_MS: i64 = 16;

/// A step in metres, with room for the rounding of single precision.
const STEP_M: f32 = 50.1e-6;

/// A sheet of tissue with a dent that wanders and deepens until `rests`.
fn sheet(side: u32, t_ms: i64, rests: i64) -> Vec<[f32; 3]> {
    let t = t_ms.min(rests) as f32 * 1e-3;
    let (cx, cy) = (0.5 + 0.3 * (2.0 * t).sin(), 0.5 + 0.2 * (3.0 * t).cos());
    let deep = 10e-3 * (4.0 * t).sin().abs();
    let node = |i: u32| {
        let (x, y) = ((i % side) as f32, (i / side) as f32);
        let (dx, dy) = (x / side as f32 - cx, y / side as f32 - cy);
        let fall = (-(dx * dx + dy * dy) / 0.02).exp();
        [deep * fall * dx, deep * fall * dy, -deep * fall]
    };
    (0..side * side).map(node).collect()
}

struct Thin {
    pair: Pair,
    side: u32,
    nodes: Arc<[u32]>,
    /// The pictures, by their times.
    was: BTreeMap<ServerTime, Vec<[f32; 3]>>,
    /// The client's displayed displacements.
    shown: BTreeMap<u32, (ServerTime, [f32; 3])>,
    worst_m: f32,
}

impl Thin {
    fn new(seed: u64, side: u32, delay_us: i64, jitter_us: i64, loss: f64) -> Self {
        let mut pair = Pair::new(seed, delay_us, jitter_us, loss);
        pair.join(1);
        Self {
            pair,
            side,
            // Every other number: the nodes between are inside.
            nodes: (0..side * side).map(|n| 2 * n + 1).collect(),
            was: BTreeMap::new(),
            shown: BTreeMap::new(),
            worst_m: 0.0,
        }
    }

    /// Shows pictures for `ms` milliseconds; the dent rests from `rests` on.
    fn play(&mut self, from_ms: i64, ms: i64, rests: i64) {
        for t in from_ms..from_ms + ms {
            if t % PERIOD_MS == 0 {
                let view_time = self.pair.server_now();
                let displacements = sheet(self.side, t, rests);
                self.was.insert(view_time, displacements.clone());
                let picture = Picture {
                    topology_version: 3,
                    view_time,
                    nodes: Arc::clone(&self.nodes),
                    displacements,
                };
                let datagram = PeerDatagram::Picture(Arc::new(picture));
                self.pair.server.send_datagram(&datagram, view_time);
            }
            self.pair.step();
            self.take();
        }
    }

    fn take(&mut self) {
        for event in self.pair.client_events.drain(..) {
            let ClientEvent::Displacements(d) = event else {
                continue;
            };
            assert_eq!((d.topology_version, d.step_um), (3, PICTURE_STEP_UM));
            let was = &self.was[&d.view_time];
            for (node, at) in d.nodes {
                self.worst_m = self.worst_m.max(apart(at, was[node as usize / 2]));
                let shown = self.shown.entry(node).or_insert((d.view_time, at));
                if d.view_time >= shown.0 {
                    *shown = (d.view_time, at);
                }
            }
        }
    }

    /// The largest error of a displayed node against the last picture, m.
    fn off_m(&self) -> f32 {
        let (_, last) = self.was.last_key_value().unwrap();
        let of = |(node, at): (&u32, &[f32; 3])| {
            apart(self.shown.get(node).map_or([0.0; 3], |s| s.1), *at)
        };
        self.nodes.iter().zip(last).map(of).fold(0.0, f32::max)
    }

    fn bits_per_s(&self, seconds: f64) -> f64 {
        let (datagrams, bytes) = self.pair.down.datagrams;
        (bytes + datagrams * OVERHEAD_BYTES as u64) as f64 * 8.0 / seconds
    }
}

fn apart(a: [f32; 3], b: [f32; 3]) -> f32 {
    let square = |i: usize| (a[i] - b[i]) * (a[i] - b[i]);
    (0..3).map(square).sum::<f32>().sqrt()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    #[test]
    fn losses_leave_no_error_at_rest_and_only_sent_displacements_are_shown(
        seed in 0_u64..1000,
        delay_us in 1_000_i64..150_000,
        jitter_us in 0_i64..20_000,
        loss in 0.0_f64..0.3,
    ) {
        let mut thin = Thin::new(seed, 40, delay_us, jitter_us, loss);
        thin.play(0, 1500, 1500);
        // Within a step of the picture of its own moment, however many datagrams were lost before it.
        prop_assert!(thin.worst_m < STEP_M, "{}", thin.worst_m);
        thin.play(1500, 6000, 1500);
        prop_assert!(thin.off_m() < STEP_M, "{} m after it has rested", thin.off_m());
        prop_assert_eq!(thin.pair.server.picture_stats().unwrap().waiting, 0);
    }
}

#[test]
fn rate_holds_under_overload_and_waiting_nodes_are_counted_and_sent_later() {
    // 62,500 nodes that all move: ten times the capacity.
    let mut thin = Thin::new(1, 250, 20_000, 5_000, 0.02);
    let before = thin.pair.down.datagrams;
    thin.play(0, 2000, 2000);
    let (datagrams, bytes) = thin.pair.down.datagrams;
    let cost = bytes - before.1 + (datagrams - before.0) * OVERHEAD_BYTES as u64;
    let most = RATE * (2.0 + SAVED_S) + 1200.0;
    assert!((cost as f64) < most, "{cost} of {most} B");
    assert!(
        (cost as f64) > 0.9 * most,
        "room was left: {cost} of {most} B"
    );
    assert!(thin.pair.server.picture_stats().unwrap().waiting > 1000);
    thin.play(2000, 4000, 2000);
    assert!(thin.off_m() < STEP_M, "{}", thin.off_m());
}

#[test]
fn nodes_with_the_largest_error_are_sent_first() {
    let mut thin = Thin::new(1, 250, 1_000, 0, 0.0);
    thin.play(0, 3000, 0);
    assert!(thin.off_m() < STEP_M);
    // A sudden deep dent: its large errors are sent within a tenth of a second, then the rest.
    thin.play(400, 100, 400);
    assert!(thin.off_m() < 1e-3, "{}", thin.off_m());
}

#[test]
fn picture_at_rest_costs_almost_nothing() {
    let mut thin = Thin::new(1, 60, 20_000, 0, 0.0);
    thin.play(0, 2000, 500);
    thin.pair.down.datagrams = (0, 0);
    thin.play(2000, 2000, 500);
    assert!(thin.bits_per_s(2.0) < 25_000.0, "{}", thin.bits_per_s(2.0));
}
