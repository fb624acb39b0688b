//! Sites that begin with a snapshot.

use palpate_protocol::handshake::SnapshotInfo;
use palpate_tissue::snapshot::snapshot;
use palpate_tissue::{BladePoint, CutHistory, CutStroke, StrokePart, Topology, Vec3};

use super::tests::*;
use super::*;
use crate::test_support::soft_block;

/// A snapshot of cuts at these places, and the welcome of a newcomer after them.
fn after_cuts(places_mm: &[f64]) -> (Welcome, ClientEvent) {
    let uncut = Arc::new(Topology::new(soft_block([6, 6, 4])));
    let (mut topology, mut history) = (Arc::clone(&uncut), CutHistory::new(uncut));
    for x in places_mm {
        let point = |y: f64| BladePoint {
            tip: Vec3::new(*x, y, 6.0) * 1e-3,
            axis: Vec3::z(),
            depth_m: 0.02,
        };
        let points = (0..7).map(|i| point(4.0 * f64::from(i))).collect();
        let stroke = CutStroke {
            points,
            width_m: 0.0,
        };
        let part = StrokePart {
            stroke: Some(*x as u64),
            ..(&stroke).into()
        };
        history.cut(&mut topology, part).unwrap();
    }
    let bytes = snapshot(&topology, &history);
    let info = SnapshotInfo {
        bytes: bytes.len() as u32,
        topology_version: topology.version(),
    };
    let welcome = Welcome {
        topology_version: topology.version(),
        topology_hash: TopologyHash(topology.hash().0),
        snapshot: Some(info),
        ..welcome(0)
    };
    (welcome, ClientEvent::Snapshot(bytes))
}

#[test]
fn snapshot_of_a_second_connection_replaces_that_of_the_first() {
    let (first, earlier) = after_cuts(&[4.5]);
    let (second, later) = after_cuts(&[4.5, 16.5]);
    for thin in [false, true] {
        let new = if thin { Site::thin } else { Site::new };
        let mut site = new(&first, soft_block([6, 6, 4]), None);
        tell(&mut site, earlier.clone(), 0);
        let again = ClientEvent::Welcomed(Box::new(second.clone()));
        tell(&mut site, again, 10);
        tell(&mut site, later.clone(), 11);
        tell(&mut site, ClientEvent::CaughtUp, 12);
        assert!(!site.is_resyncing() && !site.is_catching_up());
        let topology = site.replica().topology();
        assert_eq!(topology.version(), 2);
        assert_eq!(site.counters().cuts, 2);
        assert_eq!(topology.hash().0, second.topology_hash.0);
        let seen = site.seen().unwrap().0.displacement.len();
        assert_eq!(seen, topology.node_count());
    }
}

#[test]
fn damaged_snapshot_causes_resync() {
    let (welcome, event) = after_cuts(&[4.5]);
    let ClientEvent::Snapshot(mut bytes) = event else {
        unreachable!()
    };
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    let mut site = Site::new(&welcome, soft_block([6, 6, 4]), None);
    tell(&mut site, ClientEvent::Snapshot(bytes), 0);
    let why = site.poll_resync().unwrap();
    assert!(why.contains("invalid snapshot"), "{why}");
}
