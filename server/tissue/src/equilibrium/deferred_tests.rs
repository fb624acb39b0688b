//! Deferred forces are solved eventually.

use std::sync::Arc;

use super::Solver;
use crate::{Budget, Material, Shape, Tool, Topology, Vec3, block};

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
    let squares = deferred_force.iter().map(super::quad::square);
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

#[test]
fn views_feel_the_force_of_a_hand() {
    let (topology, mut hand, mut felt) = soft_block();
    let (mut view, mut seen) = (hand.another(&topology), felt.clone());
    for k in 0..150 {
        let t = f64::from(k) / 30.0;
        let tool = ball(0.02 * (0.7 * t).sin(), 8e-3 * t.min(1.0));
        let near = Budget {
            near: true,
            ..Budget::new(1, 0.02)
        };
        let [hand, view] = [
            hand.step(&topology, &mut felt, &[tool], near).reactions[0].force,
            view.step(&topology, &mut seen, &[tool], Budget::new(1, 0.02))
                .reactions[0]
                .force,
        ];
        let apart = (hand - view).norm();
        assert!(apart <= 1e-3 * hand.norm(), "{apart} N in step {k}");
    }
}

#[test]
fn quick_steps_of_a_slide_stay_close_to_converged_ones() {
    let (topology, mut view, mut seen) = soft_block();
    let (mut converged, mut shape) = (view.another(&topology), seen.clone());
    let (mut error, mut force) = (0.0, 0.0);
    for k in 0..75 {
        let t = f64::from(k) / 30.0;
        let tool = [ball(0.02 * (0.7 * t).sin(), 8e-3 * t.min(1.0))];
        let quick = view.step(&topology, &mut seen, &tool, Budget::new(1, 0.02));
        let quick = quick.reactions[0].force;
        let full = converged.step(&topology, &mut shape, &tool, Budget::new(30, 1e-3));
        let full = full.reactions[0].force;
        error += (quick - full).norm_squared();
        force += full.norm_squared();
    }
    let error = f64::sqrt(error / force);
    assert!(error < 0.01, "{error} of the converged force");
}
