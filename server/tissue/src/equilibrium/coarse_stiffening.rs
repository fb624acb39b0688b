//! Stiffness of contacts, held nodes and hardened tissue on the coarse levels.
//!
//! Coarse operators are those of the rest state, but tissue pressed nearly flat is tens of times stiffer. Corrections
//! there were too long by the same factor, so the line search accepted a fiftieth: after a retreat from 15 mm forces
//! were up to half too low for 0.1 s. So the matrix of a hardened element becomes
//!
//! ```text
//! K' = C K Cᵀ for every pair of corners,  C = (I + (B - B₀) / b₀)^½,  b₀ = tr B₀ / 3
//! ```
//!
//! where B and B₀ are the sums of the diagonal blocks of its nodes, now and at rest. The element stiffens along each
//! axis like the tissue, and keeps its null space of translations. `C D Cᵀ` is added to its diagonal bound D: coarser levels
//! add bounds of `K' - K` to their own, and `C D Cᵀ - D` is not such a bound.

use nalgebra::Matrix3;

use super::cycle::Multigrid;
use super::fine_level::{FineLevel, contact_block};
use super::hierarchy::Hierarchy;
use super::law::invert;
use super::matrix::{at, lane};
use super::mechanism::Mechanism;
use super::solver::Solver;
use crate::Vec3;

/// Ratio to the stiffness at rest, over all axes, from which the coarse levels follow an element.
const HARDENED: f32 = 1.5;
/// Coarse penalty stiffness of a held node relative to its own: for nodes in place, and for the load that moves the
/// levels after a node. For nodes in place 8 leaves 23 % of the error per iteration and 1 leaves 11 %; as a load, 4
/// to 12 reach 1 % in about three iterations.
pub(super) const PRESCRIBED_STIFFNESS: [f64; 2] = [1.0, 8.0];
/// Iterations of the matrix root: for 100 times the identity the relative error is a thousandth.
const ROOT_ROUNDS: usize = 9;

impl Solver {
    /// Stage: adds the stiffness of contacts, held nodes and hardened tissue to the coarse levels.
    pub(super) fn stiffen_levels(&mut self, u: &[Vec3]) {
        let stiffness = PRESCRIBED_STIFFNESS[usize::from(self.follows_prescribed_nodes())];
        let (hierarchy, coarse) = (&self.hierarchy, &mut self.coarse);
        coarse.clear_stiffness(hierarchy);
        let mut blocks: Vec<[f32; 6]> = vec![[0.0; 6]; self.contacts.nodes.len()];
        let contacts = &self.contacts;
        let stiffens = self.disabled.allows(Mechanism::ContactStiffness);
        contacts.pressed(u, |sample, _, kappa, n| {
            if !stiffens {
                return;
            }
            for (&node, w) in sample.nodes.iter().zip(sample.weights) {
                let block = &mut blocks[contacts.place(node)];
                for (to, v) in block.iter_mut().zip(contact_block(w * kappa, &n)) {
                    *to += v;
                }
            }
        });
        for (&node, block) in contacts.nodes.iter().zip(&blocks) {
            coarse.add_node_stiffness(hierarchy, node, block);
        }
        for &node in &self.held {
            let k = (stiffness * self.fine.own[node as usize]) as f32;
            coarse.add_node_stiffness(hierarchy, node, &[k, k, k, 0.0, 0.0, 0.0]);
        }
        if hierarchy.bottoms_out && self.disabled.allows(Mechanism::Hardening) {
            for i in 0..coarse.grids[0].refined.items.len() {
                let element = coarse.grids[0].refined.items[i];
                if let Some(c) = self.fine.hardening(hierarchy, element) {
                    coarse.harden(hierarchy, element, &c);
                }
            }
        }
        coarse.propagate_stiffness(hierarchy);
    }

    /// Whether the levels are loaded after led nodes.
    pub(super) fn follows_prescribed_nodes(&self) -> bool {
        !self.prescribed_displacements.is_empty() && self.contacts.nodes.is_empty()
    }
}

impl FineLevel {
    /// C of an element of level 1, if it has hardened.
    fn hardening(&mut self, hierarchy: &Hierarchy, element: u32) -> Option<Matrix3<f32>> {
        let (mut now, mut rest) = ([0.0; 6], [0.0; 6]);
        for &brick in hierarchy.levels[0].children.row(element) {
            let block_sum = self.block_sum[brick as usize];
            // Zero: no blocks were computed for this brick yet.
            if block_sum != [0.0; 6] {
                let at_rest = self.block_sum_at_rest(hierarchy, brick);
                for e in 0..6 {
                    now[e] += block_sum[e];
                    rest[e] += at_rest[e];
                }
            }
        }
        let trace = |m: &[f32; 6]| m[0] + m[1] + m[2];
        if trace(&now) <= HARDENED * trace(&rest) || trace(&rest) <= 0.0 {
            return None;
        }
        let per = 3.0 / f64::from(trace(&rest));
        let mut m: [f64; 6] = std::array::from_fn(|e| per * f64::from(now[e] - rest[e]));
        for m in &mut m[..3] {
            *m += 1.0;
        }
        let c = root(&m)?.map(|v| v as f32);
        Some(full(&c))
    }
}

impl Multigrid {
    /// Stiffens an element of level 1 by `c`.
    fn harden(&mut self, hierarchy: &Hierarchy, element: u32, c: &Matrix3<f32>) {
        let level = &hierarchy.levels[0];
        let (corners, own) = level.element(element);
        let grid = &mut self.grids[0];
        grid.add_stiffness(level, element, |k| {
            for (p, q) in (0..64).map(|i| (i / 8, i % 8)) {
                let block = Matrix3::from_fn(|a, b| own.get(at(p, a), lane(q, b)));
                let more = c * block * c - block;
                for (a, b) in (0..9).map(|i| (i / 3, i % 3)) {
                    k.0[at(p, a)][lane(q, b)] += more[(a, b)];
                }
            }
        });
        for (&point, bound) in corners.iter().zip(own.bound()) {
            let block = full(bound);
            let m = c * block * c;
            let more = [m.m11, m.m22, m.m33, m.m12, m.m13, m.m23];
            grid.add_bound(point, &more, 1.0);
        }
    }
}

/// The symmetric matrix with the entries xx, yy, zz, xy, xz, yz.
fn full<T: nalgebra::Scalar + Copy>(m: &[T; 6]) -> Matrix3<T> {
    Matrix3::new(m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2])
}

/// The square root of a positive definite matrix; `None` for any other. (Denman and Beavers 1976: only inverses, so all
/// machines agree.)
fn root(m: &[f64; 6]) -> Option<[f64; 6]> {
    let (mut y, mut z) = (*m, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    for _ in 0..ROOT_ROUNDS {
        let (of_y, of_z) = (invert(&y), invert(&z));
        for e in 0..6 {
            y[e] = 0.5 * (y[e] + of_z[e]);
            z[e] = 0.5 * (z[e] + of_y[e]);
        }
    }
    let error = (full(&y) * full(&y) - full(m)).norm();
    (error < 0.01 * full(m).norm()).then_some(y)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;
    use pulp::Scalar;

    use super::super::coarse_level::{CoarseLevel, apply};
    use super::super::hierarchy::Level;
    use super::super::quad::{Quad, ZERO, plus};
    use super::*;
    use crate::{Material, Topology, block};

    /// Largest eigenvalue of a level with its stiffened elements, scaled by its diagonal bounds.
    fn largest(level: &Level, grid: &CoarseLevel) -> f32 {
        let norm = |x: &[Quad]| x.as_flattened().iter().map(|v| v * v).sum::<f32>().sqrt();
        let number = |p: usize, k: usize| ((p * k + k) % 29) as f32 / 29.0 - 0.4;
        let start = |p| [number(p, 37), number(p, 23), number(p, 11), 0.0];
        let mut x: Vec<Quad> = (0..level.points()).map(start).collect();
        let mut value = 0.0;
        for _ in 0..50 {
            let mut forces = vec![ZERO; x.len()];
            for element in 0..level.corners.len() as u32 {
                let (corners, own) = level.element(element);
                let place = grid.stiffness_of[element as usize] as usize;
                let product = match grid.stiffened_elements.get(place) {
                    Some(stiffened) => stiffened.k.multiply(Scalar::new(), corners, &x),
                    None => own.multiply(Scalar::new(), corners, &x),
                };
                for (c, &point) in corners.iter().enumerate() {
                    let force = &mut forces[point as usize];
                    *force = plus(force, 1.0, &product.corner(c));
                }
            }
            let by = |(inverse, force): (&[f32; 6], &Quad)| apply(inverse, force);
            let next: Vec<Quad> = grid.inverse.iter().zip(&forces).map(by).collect();
            value = norm(&next) / norm(&x);
            x = next.iter().map(|v| v.map(|v| v / norm(&next))).collect();
        }
        value
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn bounds_of_all_levels_hold_with_hardened_elements(
            axes in prop::array::uniform3(0.3..8.0_f32),
            turn in prop::array::uniform3(-3.0..3.0_f32),
            every in 1..5_usize,
        ) {
            let material = Material { poisson: 0.45, ..Material::default() };
            let topology = Topology::new(Arc::new(block([14, 12, 10], 4e-3, &material, 1)));
            let hierarchy = Hierarchy::new(&topology);
            let mut coarse = Multigrid::new(&hierarchy);
            let r = nalgebra::Rotation3::new(turn.into()).into_inner();
            let c = r * Matrix3::from_diagonal(&axes.into()) * r.transpose();
            for element in (0..hierarchy.levels[0].corners.len() as u32).step_by(every) {
                coarse.harden(&hierarchy, element, &c);
            }
            coarse.propagate_stiffness(&hierarchy);
            for (l, (level, grid)) in hierarchy.levels.iter().zip(&coarse.grids).enumerate() {
                let largest = largest(level, grid);
                prop_assert!(largest < 1.05, "level {}: {largest}", l + 1);
            }
        }

        #[test]
        fn square_of_the_root_is_the_matrix(
            axes in prop::array::uniform3(0.2..60.0f64),
            turn in prop::array::uniform3(-3.0..3.0f64),
        ) {
            let r = nalgebra::Rotation3::new(Vec3::from(turn)).into_inner();
            let m = r * Matrix3::from_diagonal(&Vec3::from(axes)) * r.transpose();
            let c = full(&root(&[m.m11, m.m22, m.m33, m.m12, m.m13, m.m23]).unwrap());
            prop_assert!((c * c - m).norm() < 1e-2 * m.norm());
            prop_assert!(c.symmetric_eigenvalues().min() > 0.0);
        }
    }

    #[test]
    fn indefinite_matrix_has_no_root() {
        assert!(root(&[-1.0, 2.0, 3.0, 0.0, 0.0, 0.0]).is_none());
        assert!(root(&[f64::NAN; 6]).is_none());
        assert!(root(&[0.0; 6]).is_none_or(|r| r.iter().all(|v| v.abs() < 1e-2)));
    }
}
