//! Deferred forces do not stay for good.

use std::sync::Arc;

use crate::{Budget, Material, Shape, Solver, Tool, Topology, Vec3, block};

const CELL: f64 = 4e-3;

/// The element of level 1 that waits with the largest force.
fn largest(solver: &Solver) -> u32 {
    let elements = 0..solver.coarse.patches[0].owed.len() as u32;
    let largest = elements.max_by(|&a, &b| deferred(solver, a).total_cmp(&deferred(solver, b)));
    largest.expect("something waits")
}

/// The largest deferred force on a corner of an element, in N.
fn deferred(solver: &Solver, element: u32) -> f32 {
    let owed = &solver.coarse.patches[0].owed[element as usize];
    let squares = owed.iter().map(super::patch::square);
    squares.fold(0.0, f32::max).sqrt()
}

#[test]
fn large_deferred_forces_are_solved_while_a_hand_rests() {
    let material = Material {
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        poisson: 0.45,
        ..Material::default()
    };
    let topology = Topology::new(Arc::new(block([40, 24, 12], CELL, &material, 1)));
    let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
    let step = |solver: &mut Solver, shape: &mut Shape, depth: f64| {
        let centre = Vec3::new(20.0 * CELL, 12.0 * CELL, 12.0 * CELL + 8e-3 - depth);
        let budget = Budget {
            near: true,
            ..Budget::new(2, 0.02)
        };
        let tool = Tool::ball(1, centre, 8e-3);
        solver.step(&topology, shape, &[tool], budget);
    };
    for k in 0..=40 {
        step(&mut solver, &mut shape, 0.2e-3 * f64::from(k));
    }
    // The hand rests, but for a micrometre, so that steps are made.
    for round in 0..3 {
        let element = largest(&solver);
        let before = deferred(&solver, element);
        for k in 0..400 {
            step(&mut solver, &mut shape, 8e-3 + 1e-6 * f64::from(k % 2));
        }
        let after = deferred(&solver, element);
        assert!(after < 0.5 * before, "{before} {after} N in round {round}");
    }
}
