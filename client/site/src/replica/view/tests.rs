use palpate_protocol::tool::{ToolDescription, part_owner};
use palpate_protocol::{ParticipantId, ServerTime};
use palpate_tissue::{Budget, Vec3};

use super::*;
use crate::test_support::soft_block;

const CELL: f64 = 4e-3;

fn view() -> View {
    let model = soft_block([10, 10, 6]);
    View::new(Tissue::new(model))
}

fn tool(who: u16, x: f64, depth: f64) -> ToolAt {
    ToolAt {
        participant: ParticipantId(who),
        description: ToolDescription::probe(6e-3),
        position: Vec3::new(x, 5.0 * CELL, 6.0 * CELL + 6e-3 - depth),
        orientation: nalgebra::UnitQuaternion::identity(),
        buttons: 0,
        strength: 1.0,
        returns: false,
        predicted: None,
    }
}

fn thorough() -> Budget<'static> {
    Budget::new(200, 1e-5)
}

fn at(k: i64) -> ServerTime {
    ServerTime::from_micros(k * 4000)
}

#[test]
fn corrections_shrink_and_report_a_difference() {
    let tools = [tool(1, 5.0 * CELL, 3e-3)];
    let mut server = view();
    let mut client = view();
    server.step(at(0), &tools, thorough());
    client.step(at(0), &tools, thorough());
    // A difference that no contact explains.
    let planted: Vec<u32> = (300..310).collect();
    let by = planted.iter().map(|&n| (n, Vec3::x() * 1e-3));
    client.tissue.displace(&by.collect::<Vec<_>>());
    client.was_corrected = true;
    let away = |client: &View, n: u32| {
        let [a, b] = [&server, client].map(|r| r.shape().displacement[n as usize]);
        (a - b).norm()
    };
    client.step(at(1), &tools, Budget::new(0, 1.0));
    let before: Vec<f64> = planted.iter().map(|&n| away(&client, n)).collect();
    let row = |n: &u32| {
        let u = server.shape().displacement[*n as usize];
        (*n, [u.x as f32, u.y as f32, u.z as f32])
    };
    let corrections = Corrections {
        topology_version: 0,
        view_time: at(1),
        nodes: planted.iter().map(row).collect(),
    };
    let drift = client.correct(&corrections).unwrap();
    let far = before.iter().filter(|d| **d > DRIFT_TOLERATED_M).count();
    assert!(far > 0 && drift.nodes == far, "{far} {drift:?}");
    let most = before.iter().copied().fold(0.0, f64::max);
    assert!((drift.max_m - most).abs() < 1e-6);
    for (&n, &before) in planted.iter().zip(&before) {
        let rest = if before > DRIFT_TOLERATED_M {
            1.0 - BLEND
        } else {
            1.0
        };
        assert!((away(&client, n) - rest * before).abs() < 1e-6);
    }
    // A repeated correction changes nothing.
    assert_eq!(client.correct(&corrections).unwrap().nodes, 0);
    let other_version = Corrections {
        topology_version: 1,
        ..Corrections::default()
    };
    assert_eq!(client.correct(&other_version), None);
}

#[test]
fn reactions_include_the_resistance_against_cutting_blades() {
    let mut view = view();
    let toughness = view.tissue.model().regions[1].material.toughness_j_m2;
    let blade = |x: f64| ToolAt {
        description: ToolDescription::scalpel(1e-3, 0.02),
        buttons: 1,
        ..tool(2, x, 6e-3 + 2.0 * CELL)
    };
    let mut reactions = Vec::new();
    for (k, x) in [4.0, 4.2].into_iter().enumerate() {
        let tools = [tool(1, 7.0 * CELL, 3e-3), blade(x * CELL)];
        view.step(at(k as i64), &tools, thorough());
        reactions = view.reactions(&tools);
    }
    let [pressed, cut] = &reactions[..] else {
        panic!("{reactions:?}")
    };
    assert_eq!([pressed, cut].map(|r| part_owner(r.tool).0), [1, 2]);
    let expected = Vec3::x() * (-2.0 * CELL * toughness);
    assert!(
        (cut.force - expected).norm() < 0.1 * expected.norm(),
        "{}",
        cut.force
    );
}
