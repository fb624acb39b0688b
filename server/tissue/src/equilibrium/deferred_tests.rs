//! Deferred forces are solved eventually.

use std::sync::Arc;

use crate::{Budget, Material, Shape, Solver, Tool, Topology, Vec3, block};

const CELL: f64 = 4e-3;

/// The element of level 1 with the largest deferred force.
fn largest(solver: &Solver) -> u32 {
    let elements = 0..solver.coarse.grids[0].deferred_force.len() as u32;
    let largest = elements.max_by(|&a, &b| deferred(solver, a).total_cmp(&deferred(solver, b)));
    largest.expect("something waits")
}

/// The largest deferred force on a corner of an element, in N.
fn deferred(solver: &Solver, element: u32) -> f32 {
    let deferred_force = &solver.coarse.grids[0].deferred_force[element as usize];
    let squares = deferred_force.iter().map(super::coarse_level::square);
    squares.fold(0.0, f32::max).sqrt()
}

/// A soft block and a solver of it at rest.
fn soft_block() -> (Topology, Solver, Shape) {
    let material = Material {
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        poisson: 0.45,
        ..Material::default()
    };
    let topology = Topology::new(Arc::new(block([40, 24, 12], CELL, &material, 1)));
    let (solver, shape) = (Solver::new(&topology), Shape::rest(&topology));
    (topology, solver, shape)
}

/// A ball pressed into the top of the block, `x` m from its middle.
fn ball(x: f64, depth: f64) -> Tool {
    let centre = Vec3::new(20.0 * CELL + x, 12.0 * CELL, 12.0 * CELL + 8e-3 - depth);
    Tool::ball(1, centre, 8e-3)
}

#[test]
fn large_deferred_forces_are_solved_while_the_tool_rests() {
    let (topology, mut solver, mut shape) = soft_block();
    let step = |solver: &mut Solver, shape: &mut Shape, depth: f64| {
        let budget = Budget {
            near: true,
            ..Budget::new(2, 0.02)
        };
        solver.step(&topology, shape, &[ball(0.0, depth)], budget);
    };
    for k in 0..=40 {
        step(&mut solver, &mut shape, 0.2e-3 * f64::from(k));
    }
    // The tool moves by a micrometre, so that steps are made.
    for round in 0..3 {
        let element = largest(&solver);
        let before = deferred(&solver, element);
        for k in 0..100 {
            step(&mut solver, &mut shape, 8e-3 + 1e-6 * f64::from(k % 2));
        }
        let after = deferred(&solver, element);
        assert!(after < 0.5 * before, "{before} {after} N in round {round}");
    }
}

#[test]
fn cached_restricted_forces_equal_recomputed_ones() {
    let (topology, mut kept, mut shape) = soft_block();
    let mut renewed = kept.another(&topology);
    let mut other = shape.clone();
    for k in 0..200 {
        let t = f64::from(k) * 0.02;
        let tool = ball(0.02 * t.sin(), 6e-3 * (0.7 * t).sin());
        let near = k % 20 > 0;
        let budget = || Budget {
            near,
            ..Budget::new(3, 0.02)
        };
        kept.step(&topology, &mut shape, &[tool], budget());
        renewed.coarse.is_outer_restricted = false;
        renewed.step(&topology, &mut other, &[tool], budget());
        assert!(shape == other, "step {k}");
    }
}

#[test]
fn quick_step_skips_invisible_displacements() {
    for steps in [5, 20, 60] {
        let (topology, mut solver, mut shape) = soft_block();
        for k in 0..steps {
            let tool = ball(0.0, 0.1e-3 * f64::from(k));
            solver.step(&topology, &mut shape, &[tool], Budget::new(2, 0.02));
        }
        let left = shape.clone();
        solver.prolongate_all(&mut shape);
        let apart = shape.displacement.iter().zip(&left.displacement);
        let most = apart.map(|(a, b)| (a - b).amax()).fold(0.0, f64::max);
        assert!(most > 0.0 && most < 20e-6, "{most} m after {steps} steps");
    }
}
