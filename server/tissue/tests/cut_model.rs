//! A cut topology as a model: it is valid, equal in shape, and behaves as the topology does.

#![allow(clippy::unwrap_used)]

mod cut_laws;

use std::sync::Arc;

use palpate_tissue::file::{decode_model, encode_model};
use palpate_tissue::snapshot::model_hash;
use palpate_tissue::{
    BladePoint, Budget, CutStroke, SweptSurface, Tissue, Tool, Topology, Vec3, block, cut,
};
use proptest::prelude::*;

const D: f64 = 0.004;
const CELLS: [usize; 3] = [9, 9, 6];

fn uncut() -> Topology {
    Topology::new(Arc::new(block(CELLS, D, &cut_laws::rubber(), 1)))
}

/// A slit from the top, oblique to the lattice; lengths in spacings.
fn slit(from: [f64; 2], to: [f64; 2], lean: f64, depth: f64, width_m: f64) -> CutStroke {
    let axis = Vec3::new(lean, 0.3 * lean, 1.0).normalize();
    let point = |[x, y]: [f64; 2]| BladePoint {
        tip: Vec3::new(x, y, CELLS[2] as f64 + 0.5) * D - axis * depth * D,
        axis,
        depth_m: depth * D,
    };
    CutStroke {
        points: vec![point(from), point(to)],
        width_m,
    }
}

fn place() -> impl Strategy<Value = [f64; 2]> {
    [-1.0..10.0f64, -1.0..10.0f64]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..Default::default() })]

    #[test]
    fn model_of_a_cut_topology_has_its_cells_and_a_closed_surface(
        strokes in prop::collection::vec(
            (place(), place(), -0.6..0.6f64, 2.0..8.0f64, prop_oneof![Just(0.0), Just(1e-3)]),
            1..5,
        ),
    ) {
        let mut topology = uncut();
        for (from, to, lean, depth, width) in strokes {
            let _ = cut(&mut topology, &slit(from, to, lean, depth, width));
        }
        let model = topology.to_model();
        let read = decode_model(&encode_model(&model)).unwrap();
        prop_assert_eq!(model_hash(&read), model_hash(&model));
        let again = Topology::new(Arc::new(read));
        prop_assert_eq!(again.node_count(), topology.node_count());
        cut_laws::check_surface(&again);
        cut_laws::check_derived(&again);
        prop_assert_eq!(again.component_volumes(), topology.component_volumes());
        prop_assert_eq!(again.boundary().faces.len(), topology.boundary().faces.len());
    }
}

#[test]
fn model_of_a_cut_topology_resists_a_tool_as_the_topology_does() {
    let mut topology = uncut();
    cut(
        &mut topology,
        &slit([2.1, -1.0], [6.7, 10.0], 0.2, 4.0, 0.0),
    )
    .unwrap();
    let model = topology.to_model();
    let tool = Tool::ball(1, Vec3::new(7.0, 3.0, CELLS[2] as f64 + 1.0) * D, 2.0 * D);
    let force = |mut tissue: Tissue| {
        for _ in 0..40 {
            tissue.step(&[tool], Budget::new(100, 1e-6));
        }
        tissue.report().reactions[0].force
    };
    let (cut, stored) = (
        force(Tissue::at_rest(topology)),
        force(Tissue::new(model.into())),
    );
    assert!(cut.norm() > 0.05, "{cut}");
    // The tool is beside the wound, because diagonals of opened faces may differ, and with them contact samples.
    assert!(
        (cut - stored).norm() < 1e-3 * cut.norm(),
        "{cut} and {stored}"
    );
}

#[test]
fn doubled_nodes_lie_on_the_swept_surface() {
    let mut topology = uncut();
    let stroke = slit([2.1, -1.0], [6.7, 10.0], 0.0, 8.0, 0.0);
    let surface = SweptSurface::of(&stroke, D).unwrap();
    let outcome = cut(&mut topology, &stroke).unwrap();
    assert!(outcome.doubled.len() > 20);
    let distances = outcome
        .doubled
        .iter()
        .map(|d| surface.distance_m(&topology.rest(d.0)).unwrap());
    let near = distances.filter(|d| *d < 1e-6 * D).count();
    assert!(
        near + outcome.nodes_short >= outcome.doubled.len(),
        "{near} of {}",
        outcome.doubled.len()
    );
    let away = topology.rest(0) + Vec3::new(40.0 * D, 0.0, 0.0);
    assert_eq!(surface.distance_m(&away), None);
    let none = CutStroke {
        points: Vec::new(),
        ..stroke
    };
    assert!(SweptSurface::of(&none, D).is_err());
}
