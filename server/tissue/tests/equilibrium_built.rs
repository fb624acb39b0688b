//! The equilibrium on built anatomy: irregular cells, several materials, nodes flat on an oblique surface; and
//! on a cut lattice.

#![allow(clippy::unwrap_used)]

mod places;

use std::sync::Arc;

use palpate_tissue::sample::Sample;
use palpate_tissue::{
    BladePoint, Budget, CutStroke, Material, Shape, Solver, Tool, Topology, Vec3, block, build, cut,
};

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
        let mut shape = Shape::rest(&topology);
        let mut solver = Solver::new(&topology);
        let mut press = |depth_mm: f64| {
            let tool = Tool::ball(1, at + direction * (RADIUS_M - depth_mm * 1e-3), RADIUS_M);
            let report = solver.step(&topology, &mut shape, &[tool], Budget::new(4, 1e-2));
            assert!(!report.fell_back, "at {depth_mm} mm along {direction:?}");
            let moved = shape.displacement.iter().map(Vec3::norm);
            (
                report.reactions[0].force.dot(&direction),
                moved.fold(0.0, f64::max) * 1e3,
            )
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

#[test]
fn solver_updated_by_a_cut_agrees_with_a_new_one() {
    let fat = Material::built_in("fat").unwrap();
    let mut topology = Topology::new(Arc::new(block([14, 14, 8], 0.004, &fat, 1)));
    let mut shape = Shape::rest(&topology);
    let mut solver = Solver::new(&topology);
    let tool = Tool::ball(
        1,
        Vec3::new(0.022, 0.028, 0.032 + RADIUS_M - 0.003),
        RADIUS_M,
    );
    solver.step(&topology, &mut shape, &[tool], Budget::new(60, 1e-4));
    let stroke = CutStroke {
        points: (0..8)
            .map(|i| BladePoint {
                tip: Vec3::new(0.0301, 0.012 + 0.004 * f64::from(i), 0.018),
                axis: Vec3::z(),
                depth_m: 0.03,
            })
            .collect(),
        width_m: 0.0,
    };
    let outcome = cut(&mut topology, &stroke).unwrap();
    assert!(!outcome.doubled.is_empty());
    shape.follow(&topology, &outcome);
    solver.follow(&topology, &outcome.touched);
    let mut followed = 0.0;
    for _ in 0..6 {
        let report = solver.step(&topology, &mut shape, &[tool], Budget::new(100, 1e-6));
        assert!(!report.fell_back);
        followed = report.reactions[0].force.z;
    }
    assert!(solver.residual_over_all(&shape) < 1e-4);

    let mut fresh_shape = Shape::rest(&topology);
    let mut fresh = Solver::new(&topology);
    let mut cold = 0.0;
    for tenth in 0..=30 {
        let mut tool = tool;
        tool.centre.z += 0.003 - f64::from(tenth) * 1e-4;
        let report = fresh.step(&topology, &mut fresh_shape, &[tool], Budget::new(100, 1e-6));
        cold = report.reactions[0].force.z;
    }
    assert!(
        (followed / cold - 1.0).abs() < 0.01,
        "after following {followed} N, from scratch {cold} N"
    );
}
