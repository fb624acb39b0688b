//! The limit of coarse corrections.

use std::sync::Arc;

use super::quad::square;
use super::solver::Solver;
use crate::{Budget, Material, Shape, Tool, Topology, Vec3, block};

const SPACING: f64 = 2e-3;
const REACH: f32 = 2e-3;

/// A solver whose active sets have inner points and rims on two levels at least.
fn pressed() -> Solver {
    let model = block([32, 32, 16], SPACING, &Material::default(), 1);
    let topology = Topology::new(Arc::new(model));
    let (mut solver, mut shape) = (Solver::new(&topology), Shape::rest(&topology));
    let ball = Tool::ball(1, Vec3::new(32e-3, 32e-3, 38e-3), 8e-3);
    let budget = Budget {
        near: true,
        ..Budget::new(1, 0.02)
    };
    solver.step(&topology, &mut shape, &[ball], budget);
    solver
}

#[test]
fn limit_shortens_long_corrections_alone_and_rims_follow() {
    let mut solver = pressed();
    let (hierarchy, coarse) = (&solver.hierarchy, &mut solver.coarse);
    let (short, long) = ([3e-4, -2e-4, 5e-4, 0.0], [0.06, -0.03, 0.02, 0.0_f32]);
    let (mut rims, mut followed) = (0, 0);
    for l in (0..coarse.grids.len()).rev() {
        let (finer, coarser) = coarse.grids.split_at_mut(l + 1);
        let (grid, above) = (&mut finer[l], coarser.first());
        for (i, &point) in grid.points.items.iter().enumerate() {
            let p = point as usize;
            grid.e[p] = match above {
                Some(above) if !grid.free[p] => {
                    rims += 1;
                    hierarchy.levels[l].prolongation.interpolate(p, &above.e)
                }
                _ if i % 5 == 0 => long,
                _ => short,
            };
        }
    }
    assert!(rims > 100, "{rims}");
    let before: Vec<_> = coarse.grids.iter().map(|g| g.e.clone()).collect();
    coarse.limit_corrections(hierarchy, REACH);
    for (l, before) in before.iter().enumerate() {
        let (finer, coarser) = coarse.grids.split_at(l + 1);
        let (grid, above) = (&finer[l], coarser.first());
        for &point in &grid.points.items {
            let p = point as usize;
            let (e, was) = (grid.e[p], before[p]);
            assert!(square(&e).sqrt() <= 1.001 * REACH);
            if let Some(above) = above.filter(|_| !grid.free[p]) {
                assert_eq!(e, hierarchy.levels[l].prolongation.interpolate(p, &above.e));
                followed += usize::from(e != was);
            } else if square(&was).sqrt() <= REACH {
                assert_eq!(e, was);
            } else {
                let cosine = (0..3).map(|a| e[a] * was[a]).sum::<f32>();
                let lengths = (square(&e) * square(&was)).sqrt();
                assert!(cosine > 0.9999 * lengths && lengths > 0.0);
            }
        }
    }
    assert!(followed > 0, "no rim point followed a shortened correction");
}
