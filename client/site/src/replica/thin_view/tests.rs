use std::sync::Arc;

use palpate_tissue::{BladePoint, CutStroke, Material, block, cut};

use super::*;

fn topology() -> Topology {
    let soft = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    };
    Topology::new(Arc::new(block([6, 6, 4], 4e-3, &soft, 1)))
}

fn through(topology: &mut Topology) -> CutOutcome {
    let at = |i: u32| BladePoint {
        tip: Vec3::new(0.004 * f64::from(i), 0.0121, 0.008),
        axis: Vec3::z(),
        depth_m: 0.03,
    };
    let stroke = CutStroke {
        points: (0..7).map(at).collect(),
        width_m: 0.0,
    };
    cut(topology, &stroke).unwrap()
}

fn displacements(version: u32, at_us: i64, nodes: &[(u32, f32)]) -> Displacements {
    Displacements {
        step_um: 50,
        topology_version: version,
        view_time: ServerTime::from_micros(at_us),
        waiting: 7,
        nodes: nodes.iter().map(|(n, z)| (*n, [0.0, 0.0, *z])).collect(),
    }
}

fn z(view: &ThinView, node: u32) -> f64 {
    view.shape().displacement[node as usize].z
}

#[test]
fn newest_displacement_is_shown_for_any_arrival_order() {
    let topology = topology();
    let mut view = ThinView::new(&topology);
    view.receive(displacements(0, 2000, &[(3, 2.0), (4, 2.0)]), None);
    view.advance(ServerTime::from_micros(2000));
    view.receive(displacements(0, 1000, &[(3, 1.0), (5, 1.0)]), None);
    view.advance(ServerTime::from_micros(2000));
    assert_eq!([3, 4, 5].map(|n| z(&view, n)), [2.0, 2.0, 1.0]);
    assert_eq!((view.counters().late, view.counters().waiting), (1, 7));
}

#[test]
fn displacements_are_shown_at_their_time_or_early_on_overflow() {
    let topology = topology();
    let mut view = ThinView::new(&topology);
    view.receive(displacements(0, 3000, &[(3, 3.0)]), None);
    view.receive(displacements(0, 2000, &[(3, 2.0)]), None);
    let mut at = |us: i64| {
        view.advance(ServerTime::from_micros(us));
        z(&view, 3)
    };
    assert_eq!([1999, 2000, 2999, 3000].map(&mut at), [0.0, 2.0, 2.0, 3.0]);
    for i in 0..1000 {
        view.receive(displacements(0, 1_000_000 + i, &[(3, i as f32)]), None);
    }
    assert_eq!(view.waiting.len(), WAITING_MAX);
    assert_eq!(z(&view, 3), (999 - WAITING_MAX) as f64);
}

#[test]
fn displacement_waits_for_its_cut_and_doubled_node_inherits() {
    let mut topology = topology();
    let mut view = ThinView::new(&topology);
    let before = topology.node_count() as u32;
    view.receive(displacements(0, 1000, &[(0, 0.5)]), None);
    let outcome = through(&mut topology);
    let (new, from) = outcome.doubled[0];
    view.receive(displacements(0, 1000, &[(from, 1.0)]), None);
    view.receive(displacements(1, 2000, &[(0, 3.0), (new + 1, 4.0)]), None);
    view.advance(ServerTime::from_micros(2000));
    assert_eq!(view.shape().displacement.len(), before as usize);
    assert!((z(&view, 0) - 0.5).abs() < 1e-9, "newer topology");
    view.follow(&topology, &outcome);
    assert_eq!(view.shape().displacement.len(), topology.node_count());
    assert_eq!([0, new, new + 1].map(|n| z(&view, n)), [3.0, 1.0, 4.0]);
}

#[test]
fn impossible_node_is_counted_and_takes_no_memory() {
    let topology = topology();
    let mut view = ThinView::new(&topology);
    view.receive(displacements(0, 0, &[(1, 1.0), (33_000_000, 1.0)]), None);
    view.advance(ServerTime::ZERO);
    assert_eq!((view.counters().received, view.counters().unknown), (1, 1));
    assert!(view.received.len() < 10);
}

#[test]
fn tools_lag_with_latest_datagram_and_recover_slowly() {
    let topology = topology();
    let mut view = ThinView::new(&topology);
    let mut at = |s_us: i64, behind_us: i64| {
        let s = ServerTime::from_micros(s_us);
        view.receive(displacements(0, s_us - behind_us, &[]), Some(s));
        view.lag().as_micros()
    };
    assert_eq!(at(0, 50_000), 50_000);
    assert_eq!(at(10_000, 80_000), 80_000);
    let soon = at(20_000, 50_000);
    assert!((79_000..80_000).contains(&soon), "{soon}");
    let later = (3..2000).map(|i| at(i * 10_000, 50_000)).last().unwrap();
    assert!((50_000..51_000).contains(&later), "{later}");
    assert_eq!(at(30_000_000, 20_000_000), LAG_MAX.as_micros());
}
