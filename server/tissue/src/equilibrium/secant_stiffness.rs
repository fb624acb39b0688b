//! Secant stiffness of deferred elements.
//!
//! The effective stiffness of a deferred element belongs to the rest state. Tissue hardens: an element that was refined
//! under a deep press and is deferred during the withdrawal would release too little force, so that the force on the tool
//! stays too high. So the effective stiffness K of an element of level 1 is multiplied by
//!
//! ```text
//! secant = - Σ f · P t / (tᵀ K t)
//! ```
//!
//! f are the forces of its bricks when it was last refined, and t the accumulated coarse corrections at its corners, both
//! from the reference state. A displacement by -t then releases the work of f along t (secant stiffness of nonlinear
//! finite elements, e.g. Crisfield 1991, chapter 1). Without the rotation in t withdrawals are half as far off again:
//! forces of a deformed brick have a moment about its corners at rest.

use super::brick::LOCALS;
use super::coarse_level::CoarseLevel;
use super::element::WEIGHTS;
use super::fine_level::FineLevel;
use super::hierarchy::Hierarchy;
use super::matrix::Corners;
use super::quad::{ZERO, plus};
use super::reference_state::ReferenceState;

/// Bounds of the factor. The lower one keeps the effective stiffness where t is small; with 0.3 slides were three times as
/// far off. Upper bounds of 3 and 100 give the same forces.
const SECANTS: [f32; 2] = [1.0, 8.0];

impl FineLevel {
    /// Updates the secant stiffness of the refined elements of level 1. The forces of their bricks and the totals of their
    /// corners must be current.
    pub(super) fn update_secants(
        &self,
        hierarchy: &Hierarchy,
        grid: &mut CoarseLevel,
        reference: Option<&ReferenceState>,
    ) {
        // Forces and totals from different states have no common work.
        if !grid.starts_at_reference {
            return;
        }
        let level = &hierarchy.levels[0];
        for &element in &grid.refined.items {
            let corners = level.corners[element as usize];
            let by = corners.map(|p| {
                let [x, y, z] = grid.total[p as usize].map(|v| v as f32);
                [x, y, z, 0.0]
            });
            let effective = level.force(pulp::Scalar::new(), element, &by, Some(1.0));
            let released = -work(&self.restricted(hierarchy, element, reference), &by);
            let secant = released / work(&effective, &by);
            // Also where both are zero.
            grid.secant[element as usize] = if secant > SECANTS[0] {
                secant.min(SECANTS[1])
            } else {
                SECANTS[0]
            };
        }
    }

    /// Forces of the bricks of an element of level 1 beyond those at the reference state, restricted to its corners, in N.
    fn restricted(
        &self,
        hierarchy: &Hierarchy,
        element: u32,
        reference: Option<&ReferenceState>,
    ) -> Corners {
        let mut sum = [ZERO; 8];
        for &brick in hierarchy.levels[0].children.row(element) {
            let b = &hierarchy.bricks[brick as usize];
            let f = &self.forces[brick as usize];
            let before = reference.map_or(&[[0.0; LOCALS]; 3], |r| r.of_brick(brick));
            // Pinned nodes follow no element.
            let moves = |&i: &usize| b.present >> i & 1 == 1 && !self.fixed[b.nodes[i] as usize];
            for i in (0..LOCALS).filter(moves) {
                let [x, y, z] = [0, 1, 2].map(|a| f[a][i] - before[a][i]);
                for (to, w) in sum.iter_mut().zip(WEIGHTS[i]) {
                    *to = plus(to, w as f32, &[x, y, z, 0.0]);
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
    fn soft_block(gravity: f64) -> (Topology, Solver, Shape) {
        let material = Material {
            young_pa: 10e3,
            poisson: 0.45,
            ..Material::default()
        };
        let mut model = block([40, 40, 14], CELL, &material, 1);
        model.gravity[2] = gravity;
        let topology = Topology::new(Arc::new(model));
        let (solver, shape) = (Solver::new(&topology), Shape::rest(&topology));
        (topology, solver, shape)
    }

    fn ball(depth: f64) -> [Tool; 1] {
        let centre = Vec3::new(20.0 * CELL, 20.0 * CELL, 14.0 * CELL + 8e-3 - depth);
        [Tool::ball(1, centre, 8e-3)]
    }

    fn quick(iterations: usize) -> Budget<'static> {
        Budget {
            near: true,
            ..Budget::new(iterations, 0.02)
        }
    }

    #[test]
    fn return_along_the_displacement_releases_the_work_of_its_force() {
        let (topology, mut solver, mut shape) = soft_block(0.0);
        for k in 0..=30 {
            solver.step(
                &topology,
                &mut shape,
                &ball(0.4e-3 * f64::from(k)),
                quick(1),
            );
        }
        let (hierarchy, fine) = (&solver.hierarchy, &mut solver.fine);
        let grid = &mut solver.coarse.grids[0];
        fine.evaluate_bricks(hierarchy, &shape.displacement);
        fine.update_secants(hierarchy, grid, None);
        let level = &hierarchy.levels[0];
        let mut hardened = 0;
        for &element in &grid.refined.items {
            let secant = grid.secant[element as usize];
            if secant <= SECANTS[0] || secant >= SECANTS[1] {
                continue;
            }
            hardened += 1;
            let corners = level.corners[element as usize];
            let by = corners.map(|p| {
                let [x, y, z] = grid.total[p as usize].map(|v| v as f32);
                [x, y, z, 0.0]
            });
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
            let back = by.map(|v| v.map(|v| -v));
            let answer = level.force(pulp::Scalar::new(), element, &back, Some(secant));
            // The answer is the force of the tissue with the opposite sign: K e.
            let released = -f64::from(work(&answer, &by));
            assert!(
                (released - along).abs() < 1e-2 * along,
                "{released} {along} N m"
            );
        }
        assert!(hardened > 10, "{hardened} elements");
    }

    #[test]
    fn withdrawal_follows_the_converged_force_more_closely() {
        let withdraw = |mechanism: Option<Mechanism>| {
            let (topology, mut quick_solver, mut quick_shape) = soft_block(0.0);
            if let Some(mechanism) = mechanism {
                quick_solver.disable(mechanism);
            }
            let (mut converged, mut shape) = (quick_solver.another(&topology), quick_shape.clone());
            let depths = (0..=40).chain((0..40).rev());
            let (mut error, mut force) = (0.0, 0.0);
            for (k, depth) in depths.enumerate() {
                let tool = ball(0.4e-3 * f64::from(depth));
                let report = quick_solver.step(&topology, &mut quick_shape, &tool, quick(1));
                let felt = report.reactions[0].force;
                if k > 40 && k % 4 == 0 {
                    let budget = Budget::new(100, 1e-3);
                    let report = converged.step(&topology, &mut shape, &tool, budget);
                    error += (felt - report.reactions[0].force).norm_squared();
                    force += report.reactions[0].force.norm_squared();
                }
            }
            f64::sqrt(error / force)
        };
        let with = withdraw(None);
        let without = withdraw(Some(Mechanism::SecantStiffness));
        assert!(with < 0.8 * without && with < 0.1, "{with} {without}");
    }

    #[test]
    fn secants_count_from_the_state_under_gravity() {
        let largest = |gravity| {
            let (topology, mut solver, mut shape) = soft_block(gravity);
            for k in 0..=20 {
                let tool = ball(0.4e-3 * f64::from(k));
                // Single iterations lag behind the tool.
                solver.step(&topology, &mut shape, &tool, quick(4));
            }
            let secants = &solver.coarse.grids[0].secant;
            secants.iter().fold(0.0, |most: f32, s| most.max(*s))
        };
        let [without, with] = [0.0, -40.0].map(largest);
        assert!(
            without > 1.2 && (with / without - 1.0).abs() < 0.1,
            "{without} {with}"
        );
    }
}
