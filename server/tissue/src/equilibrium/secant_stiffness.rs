//! Secant stiffness of deferred elements.
//!
//! The effective stiffness of a deferred element belongs to the rest state. Tissue hardens: an element that was refined
//! under a deep press and is deferred during the withdrawal would shed too little force, and the tool would feel tissue
//! that stays behind. So the effective stiffness K of an element of level 1 is multiplied by
//!
//! ```text
//! secant = - Σ f · P t / (tᵀ K t)
//! ```
//!
//! f are the forces of its bricks when it was last refined, and t its corner displacements from the rest shape. A return
//! by -t takes away the force along t (secant stiffness of nonlinear finite elements, e.g. Crisfield 1991, chapter 1).

use super::brick::LOCALS;
use super::coarse_level::CoarseLevel;
use super::element::WEIGHTS;
use super::fine_level::FineLevel;
use super::hierarchy::Hierarchy;
use super::matrix::Corners;
use super::quad::{ZERO, plus};

/// Bounds of the factor. Below 1 an element with little displacement would defer almost anything. Elements that have
/// only turned have almost no energy; an upper bound of 3 or 100 gives the same forces.
const SECANTS: [f32; 2] = [1.0, 8.0];

impl FineLevel {
    /// Updates the secant stiffness of the refined elements of level 1. The forces of their bricks must be current.
    pub(super) fn update_secants(&self, hierarchy: &Hierarchy, grid: &mut CoarseLevel) {
        let level = &hierarchy.levels[0];
        for &element in &grid.refined.items {
            let corners = level.corners[element as usize];
            let by = corners.map(|p| {
                let [x, y, z] = grid.total[p as usize].map(|v| v as f32);
                [x, y, z, 0.0]
            });
            let effective = level.force(pulp::Scalar::new(), element, &by, Some(1.0));
            let energy = work(&effective, &by);
            let secant = -work(&self.restricted(hierarchy, element), &by) / energy;
            grid.secant[element as usize] = if energy > 0.0 {
                secant.clamp(SECANTS[0], SECANTS[1])
            } else {
                1.0
            };
        }
    }

    /// Forces of the bricks of an element of level 1, restricted to its corners, in N.
    fn restricted(&self, hierarchy: &Hierarchy, element: u32) -> Corners {
        let mut sum = [ZERO; 8];
        for &brick in hierarchy.levels[0].children.row(element) {
            let (b, f) = (
                &hierarchy.bricks[brick as usize],
                &self.forces[brick as usize],
            );
            for i in (0..LOCALS).filter(|i| b.present >> i & 1 == 1) {
                let force = [f[0][i], f[1][i], f[2][i], 0.0];
                for (to, w) in sum.iter_mut().zip(WEIGHTS[i]) {
                    *to = plus(to, w as f32, &force);
                }
            }
        }
        sum
    }
}

/// Work of these forces along these displacements, in N m.
fn work(forces: &Corners, by: &Corners) -> f32 {
    let pairs = forces.as_flattened().iter().zip(by.as_flattened());
    pairs.map(|(f, v)| f * v).sum()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::Solver;
    use super::*;
    use crate::{Budget, Material, Mechanism, Shape, Tool, Topology, Vec3, block};

    const CELL: f64 = 2e-3;

    /// Soft tissue over a pinned floor, at rest.
    fn soft_block() -> (Topology, Solver, Shape) {
        let material = Material {
            young_pa: 10e3,
            poisson: 0.45,
            ..Material::default()
        };
        let topology = Topology::new(Arc::new(block([40, 40, 14], CELL, &material, 1)));
        let (solver, shape) = (Solver::new(&topology), Shape::rest(&topology));
        (topology, solver, shape)
    }

    fn ball(depth: f64) -> [Tool; 1] {
        let centre = Vec3::new(20.0 * CELL, 20.0 * CELL, 14.0 * CELL + 8e-3 - depth);
        [Tool::ball(1, centre, 8e-3)]
    }

    fn quick() -> Budget<'static> {
        Budget {
            near: true,
            ..Budget::new(1, 0.02)
        }
    }

    #[test]
    fn return_along_the_displacement_takes_its_force_away() {
        let (topology, mut solver, mut shape) = soft_block();
        for k in 0..=30 {
            solver.step(&topology, &mut shape, &ball(0.4e-3 * f64::from(k)), quick());
        }
        let (hierarchy, fine) = (&solver.hierarchy, &mut solver.fine);
        let grid = &mut solver.coarse.grids[0];
        fine.evaluate_bricks(hierarchy, &shape.displacement);
        fine.update_secants(hierarchy, grid);
        let level = &hierarchy.levels[0];
        let mut hardened = 0;
        for &element in &grid.refined.items {
            let secant = grid.secant[element as usize];
            if secant <= SECANTS[0] || secant >= SECANTS[1] {
                continue;
            }
            hardened += 1;
            let corners = level.corners[element as usize];
            let back = corners.map(|p| {
                let [x, y, z] = grid.total[p as usize].map(|v| -v as f32);
                [x, y, z, 0.0]
            });
            let answer = level.force(pulp::Scalar::new(), element, &back, Some(secant));
            let mut along = 0.0;
            for &brick in level.children.row(element) {
                let forces = &fine.forces[brick as usize];
                for (i, &node) in hierarchy.bricks[brick as usize].nodes.iter().enumerate() {
                    let prolongation = &hierarchy.prolongation;
                    let by = prolongation.interpolate_exactly(node as usize, &grid.total);
                    let parts = by.iter().zip(forces);
                    along -= parts.map(|(v, f)| v * f64::from(f[i])).sum::<f64>();
                }
            }
            let shed = f64::from(-work(&answer, &back)).abs();
            assert!((shed - along).abs() < 1e-2 * along, "{shed} {along} N m");
        }
        assert!(hardened > 10, "{hardened} elements");
    }

    #[test]
    fn withdrawal_follows_the_converged_force_more_closely() {
        let withdraw = |mechanism: Option<Mechanism>| {
            let (topology, mut hand, mut felt) = soft_block();
            if let Some(mechanism) = mechanism {
                hand.disable(mechanism);
            }
            let (mut converged, mut shape) = (hand.another(&topology), felt.clone());
            let depths = (0..=40).chain((0..40).rev());
            let mut error = 0.0;
            for (k, depth) in depths.enumerate() {
                let tool = ball(0.4e-3 * f64::from(depth));
                let felt = hand.step(&topology, &mut felt, &tool, quick()).reactions[0].force;
                if k > 40 && k % 4 == 0 {
                    let full = Budget::new(100, 1e-3);
                    let full = converged.step(&topology, &mut shape, &tool, full);
                    error += (felt - full.reactions[0].force).norm_squared();
                }
            }
            error.sqrt()
        };
        let with = withdraw(None);
        let without = withdraw(Some(Mechanism::SecantStiffness));
        assert!(with < 0.8 * without, "{with} {without} N");
    }
}
