//! Solvers after cuts, undos and redos, compared with new ones.

use std::sync::Arc;

use super::super::{CutPreparer, PreparedCut};
use super::*;
use crate::cut_history::CutHistory;
use crate::{BladePoint, Budget, CutStroke, Material, Tool, block};

const CELL: f64 = 4e-3;

fn topology() -> Arc<Topology> {
    let material = Material {
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        ..Material::default()
    };
    Arc::new(Topology::new(Arc::new(block(
        [32, 16, 8],
        CELL,
        &material,
        1,
    ))))
}

/// A press that slides along the block, at step `k`.
fn tool(k: usize) -> Tool {
    let depth = (0.3e-3 * k as f64).min(6e-3);
    let x = 7.0 * CELL + 0.05e-3 * k as f64;
    Tool::ball(1, Vec3::new(x, 8.0 * CELL, 8.0 * CELL + 8e-3 - depth), 8e-3)
}

fn slit(x: f64) -> CutStroke {
    let point = |i: u32| BladePoint {
        tip: Vec3::new(x * CELL, CELL * (4.0 + f64::from(i)), 4.1 * CELL),
        axis: Vec3::new(0.3, 0.0, 1.0).normalize(),
        depth_m: 0.03,
    };
    CutStroke {
        points: (0..9).map(point).collect(),
        width_m: 0.0,
    }
}

fn hand() -> Budget<'static> {
    Budget {
        near: true,
        ..Budget::new(2, 0.02)
    }
}

fn pressed(topology: &Topology) -> (Solver, Shape) {
    let (mut solver, mut shape) = (Solver::new(topology), Shape::rest(topology));
    for k in 0..40 {
        solver.step(topology, &mut shape, &[tool(k)], hand());
    }
    (solver, shape)
}

fn succeed(solver: &mut Solver, topology: &mut Arc<Topology>, shape: &mut Shape, cut: PreparedCut) {
    let mut history = CutHistory::new(Arc::clone(topology));
    solver.succeed(topology, &mut history, shape, cut);
}

fn most(a: &[Vec3], b: &[Vec3]) -> f64 {
    let apart = a.iter().zip(b).map(|(a, b)| (a - b).norm());
    apart.fold(0.0, f64::max)
}

/// Under the tool, beside it and far from it.
#[test]
fn following_a_cut_moves_no_node() {
    for x in [7.6, 10.4, 24.3] {
        let mut topology = topology();
        let (mut solver, mut shape) = pressed(&topology);
        let mut preparer = solver.preparer(&topology, CutHistory::new(Arc::clone(&topology)));
        let cut = preparer.prepare(&slit(x)).unwrap();
        let (mut other, mut expected) = pressed(&topology);
        other.prolongate_all(&mut expected);
        expected.follow(&cut.topology, &cut.outcome);
        succeed(&mut solver, &mut topology, &mut shape, cut);
        solver.prolongate_all(&mut shape);
        let moved = most(&shape.displacement, &expected.displacement);
        assert!(moved < 1e-9, "{moved} m at {x}");
    }
}

#[test]
fn equilibrium_after_cuts_is_that_of_a_new_solver() {
    let mut topology = topology();
    let (mut solver, mut shape) = pressed(&topology);
    let mut preparer = solver.preparer(&topology, CutHistory::new(Arc::clone(&topology)));
    for (i, x) in [7.6, 10.4, 24.3, 12.2].into_iter().enumerate() {
        let cut = preparer.prepare(&slit(x)).unwrap();
        succeed(&mut solver, &mut topology, &mut shape, cut);
        for k in 40 + 5 * i..45 + 5 * i {
            solver.step(&topology, &mut shape, &[tool(k)], hand());
        }
    }
    let budget = || Budget::new(300, 1e-6);
    solver.step(&topology, &mut shape, &[tool(60)], budget());
    assert!(solver.report.residual < 1e-6, "{}", solver.report.residual);
    let (mut new, mut expected) = (Solver::new(&topology), Shape::rest(&topology));
    for k in 40..=60 {
        new.step(&topology, &mut expected, &[tool(k)], Budget::new(30, 1e-3));
    }
    new.step(&topology, &mut expected, &[tool(60)], budget());
    let force = |solver: &Solver| solver.report.reactions[0].force.norm();
    let (a, b) = (force(&solver), force(&new));
    assert!((a - b).abs() < 1e-2 * b, "{a} and {b} N");
    assert!(solver.residual_over_all(&shape) < 1e-5);
}

/// The force of the hand's steps after cuts near the tool stays that of converged solves.
/// Relative error of the hand's forces against converged solves, in a press with changes at some steps.
fn error_of_quick_forces(change: impl Fn(usize, &mut CutPreparer) -> Option<PreparedCut>) -> f64 {
    let mut topology = topology();
    let (mut solver, mut shape) = pressed(&topology);
    let (mut full, mut converged) = pressed(&topology);
    let mut preparer = solver.preparer(&topology, CutHistory::new(Arc::clone(&topology)));
    let (mut squares, mut sum) = (0.0, 0.0);
    for k in 40..140 {
        if let Some(change) = change(k, &mut preparer) {
            succeed(
                &mut full,
                &mut topology.clone(),
                &mut converged,
                preparer.repeat(&change),
            );
            succeed(&mut solver, &mut topology, &mut shape, change);
        }
        solver.step(&topology, &mut shape, &[tool(k)], hand());
        full.step(&topology, &mut converged, &[tool(k)], Budget::new(60, 1e-3));
        let force = |solver: &Solver| solver.report.reactions[0].force;
        squares += (force(&solver) - force(&full)).norm_squared();
        sum += force(&full).norm_squared();
    }
    f64::sqrt(squares / sum)
}

fn slit_at_step(k: usize) -> CutStroke {
    slit(8.3 + 0.07 * f64::from(k as u32))
}

#[test]
fn quick_forces_after_cuts_are_converged_ones() {
    let error = error_of_quick_forces(|k, preparer| {
        (k % 20 == 10).then(|| preparer.prepare(&slit_at_step(k)).unwrap())
    });
    assert!(error < 0.05, "{error}");
}

/// An undo drops the displacements of the nodes that are gone and changes no other; a redo then moves nodes as the cut.
#[test]
fn undo_and_redo_move_no_node() {
    for x in [7.6, 10.4, 24.3] {
        let mut topology = topology();
        let (mut solver, mut shape) = pressed(&topology);
        let mut preparer = solver.preparer(&topology, CutHistory::new(Arc::clone(&topology)));
        let cut = preparer.prepare(&slit(x)).unwrap();
        let (outcome, cut_topology) = (Arc::clone(&cut.outcome), Arc::clone(&cut.topology));
        succeed(&mut solver, &mut topology, &mut shape, cut);
        let changes = [
            preparer.undo().unwrap().finish(),
            preparer.redo().unwrap().unwrap().finish(),
        ];
        for (change, is_undo) in changes.into_iter().zip([true, false]) {
            for k in 40..50 {
                solver.step(&topology, &mut shape, &[tool(k)], hand());
            }
            // The second one has the nodes where a prolongation puts them.
            let mut expected = shape.clone();
            prolongated(&solver, &mut expected);
            if is_undo {
                let kept = change.topology.node_count();
                expected.displacement.truncate(kept);
            } else {
                expected.follow(&cut_topology, &outcome);
            }
            succeed(&mut solver, &mut topology, &mut shape, change);
            solver.prolongate_all(&mut shape);
            assert_eq!(shape.displacement.len(), topology.node_count());
            let moved = most(&shape.displacement, &expected.displacement);
            assert!(moved < 1e-9, "{moved} m at {x}");
        }
    }
}

/// Adds all that the nodes have not yet received, without a change of the solver.
fn prolongated(solver: &Solver, shape: &mut Shape) {
    let levels = &solver.hierarchy.levels;
    let mut above: Vec<[f64; 3]> = Vec::new();
    for (grid, level) in solver.coarse.grids.iter().zip(levels).rev() {
        let mut total = grid.total.clone();
        if !above.is_empty() {
            for (p, total) in total.iter_mut().enumerate() {
                let now = level.prolongation.interpolate_exactly(p, &above);
                update_total(now, total, &mut grid.applied[p].clone());
            }
        }
        above = total;
    }
    let fine = &solver.fine;
    for (n, u) in shape.displacement.iter_mut().enumerate() {
        let is_extrapolated =
            fine.since == SetChange::Extrapolated && fine.nodes.contains(n as u32);
        if !fine.fixed[n] && !is_extrapolated {
            let now = solver.hierarchy.prolongation.interpolate_exactly(n, &above);
            *u += Vec3::from(now) - Vec3::from(fine.applied[n]);
        }
    }
}

#[test]
fn equilibrium_after_undos_is_that_of_a_new_solver() {
    let mut topology = topology();
    let uncut = Arc::clone(&topology);
    let (mut solver, mut shape) = pressed(&topology);
    let mut preparer = solver.preparer(&topology, CutHistory::new(Arc::clone(&topology)));
    let mut k = 40;
    let mut adopt = |solver: &mut Solver, topology: &mut _, shape: &mut _, cut| {
        succeed(solver, topology, shape, cut);
        k += 1;
        solver.step(topology, shape, &[tool(k)], hand());
    };
    for x in [7.6, 10.4, 24.3, 12.2] {
        let cut = preparer.prepare(&slit(x)).unwrap();
        adopt(&mut solver, &mut topology, &mut shape, cut);
    }
    for _ in 0..3 {
        let undone = preparer.undo().unwrap().finish();
        adopt(&mut solver, &mut topology, &mut shape, undone);
    }
    let redone = preparer.redo().unwrap().unwrap().finish();
    adopt(&mut solver, &mut topology, &mut shape, redone);
    let compare = |solver: &mut Solver, topology: &Topology, shape: &mut Shape| {
        let budget = || Budget::new(300, 1e-6);
        solver.step(topology, shape, &[tool(60)], budget());
        assert!(solver.report.residual < 1e-6, "{}", solver.report.residual);
        let (mut new, mut expected) = (Solver::new(topology), Shape::rest(topology));
        for k in 40..=60 {
            new.step(topology, &mut expected, &[tool(k)], Budget::new(30, 1e-3));
        }
        new.step(topology, &mut expected, &[tool(60)], budget());
        let force = |solver: &Solver| solver.report.reactions[0].force.norm();
        let (a, b) = (force(solver), force(&new));
        assert!((a - b).abs() < 1e-2 * b, "{a} and {b} N");
        assert!(solver.residual_over_all(shape) < 1e-5);
    };
    compare(&mut solver, &topology, &mut shape);
    let reset = preparer.reset().unwrap().finish();
    adopt(&mut solver, &mut topology, &mut shape, reset);
    assert_eq!(topology.hash(), uncut.hash());
    compare(&mut solver, &topology, &mut shape);
}

/// The force of the hand's steps after undos near the tool stays that of converged solves.
#[test]
fn quick_forces_after_undos_are_converged_ones() {
    let error = error_of_quick_forces(|k, preparer| match k % 30 {
        15 => Some(preparer.prepare(&slit_at_step(k)).unwrap()),
        25 => Some(preparer.undo().unwrap().finish()),
        5 => Some(preparer.redo().unwrap().unwrap().finish()),
        _ => None,
    });
    assert!(error < 0.05, "{error}");
}
