//! The equilibrium on built anatomy: irregular cells, several materials, nodes flat on an oblique surface.

#![allow(clippy::unwrap_used)]

mod places;

use std::sync::Arc;

use palpate_anatomy::build;
use palpate_anatomy::sample::Sample;
use palpate_tissue::{Budget, Tissue, Tool, Topology, Vec3};

use places::outermost;

const RADIUS_M: f64 = 0.008;

#[test]
fn deep_press_into_built_tissue_is_stable_and_leaves_no_dent() {
    let mut input = Sample::Thigh.input().unwrap();
    input.scene.spacing_m = 0.006;
    let (model, _) = build(&input, &mut |_, _| {}).unwrap();
    let topology = Topology::new(Arc::new(model));
    for direction in [Vec3::x(), -Vec3::x(), Vec3::y(), -Vec3::y()] {
        let at = outermost(&topology, direction);
        let mut tissue = Tissue::at_rest(topology.clone());
        let mut press = |depth_mm: f64| {
            let tool = Tool::ball(1, at + direction * (RADIUS_M - depth_mm * 1e-3), RADIUS_M);
            let report = tissue.step(&[tool], Budget::new(4, 1e-2));
            assert!(!report.rolled_back, "at {depth_mm} mm along {direction:?}");
            let force = report.reactions[0].force.dot(&direction);
            let moved = tissue.shape().displacement.iter().map(Vec3::norm);
            (force, moved.fold(0.0, f64::max) * 1e3)
        };
        let mut forces = Vec::new();
        for tenth in 1..=100 {
            let depth = f64::from(tenth) / 10.0;
            let (force, moved) = press(depth);
            assert!(moved < depth + 2.0, "{moved} mm at {depth} mm");
            if tenth % 20 == 0 {
                forces.push(force);
            }
        }
        assert!(
            forces.is_sorted() && forces[0] > 0.0,
            "force rises with depth along {direction:?}: {forces:?}"
        );
        for tenth in (-20..100).rev() {
            press(f64::from(tenth) / 10.0);
        }
        let left = (0..40).fold(f64::MAX, |_, _| press(-2.0).1);
        assert!(left < 0.5, "a dent of {left} mm stays along {direction:?}");
    }
}
