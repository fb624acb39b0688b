//! What contacts, held nodes and hardened tissue make of the coarse levels.
//!
//! Coarse matrices are those of the tissue at rest, and tissue that is pressed nearly flat is tens of times as
//! stiff. Their corrections there were as many times too long, so that only a fiftieth could be taken, of all of
//! them: a hand that drew back from 15 mm felt forces up to half too low for a tenth of a second. So an element that
//! has hardened stands with
//!
//! ```text
//! K' = C K Cᵀ for every pair of corners,  C = (I + (B - B₀) / b₀)^½,  b₀ = tr B₀ / 3
//! ```
//!
//! where B and B₀ are the sums of the blocks of its nodes, now and at rest: as much stiffer along each axis as the
//! tissue is, and still without resistance to moves as a whole. Its rows are bounded by `C D Cᵀ` as before by D.

use nalgebra::Matrix3;

use super::cycle::Multigrid;
use super::field::{Field, contact_block};
use super::law::invert;
use super::matrix::{at, lane};
use super::solver::Solver;
use super::structure::Structure;
use crate::Vec3;

/// How many times as stiff as at rest an element is, all axes together, from which on the levels follow it.
const HARDENED: f32 = 1.5;
/// Stiffness that stands for a held node on the coarse levels, in parts of its own: where it is already, and where the
/// levels are drawn after it. With what draws best, a cube that is carried on keeps 23 % of its error in an iteration,
/// with the node's own 11 %; drawn by 4 to 12 it comes to 1 % in three iterations or nearly.
pub(super) const HELD_STIFFNESS: [f64; 2] = [1.0, 8.0];
/// Rounds of the root: from 100 times the identity they leave a thousandth.
const ROOT_ROUNDS: usize = 9;

impl Solver {
    /// Stage: what contacts, held nodes and hardened tissue add to the coarse levels. Contacts are those that
    /// press, and those that are only `expected` to.
    pub(super) fn stiffen(&mut self, u: &[Vec3], expected: bool) {
        let stiffness = HELD_STIFFNESS[usize::from(self.draws())];
        let (structure, coarse) = (&self.structure, &mut self.coarse);
        coarse.soften(structure);
        let mut blocks: Vec<[f32; 6]> = vec![[0.0; 6]; self.contacts.nodes.len()];
        let contacts = &self.contacts;
        contacts.expected(u, |sample, depth, kappa, n| {
            if depth <= 0.0 && !expected {
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
            coarse.stiffen(structure, node, block);
        }
        for &node in &self.held {
            let k = (stiffness * self.field.own[node as usize]) as f32;
            coarse.stiffen(structure, node, &[k, k, k, 0.0, 0.0, 0.0]);
        }
        if structure.bottoms_out {
            for i in 0..coarse.patches[0].refined.items.len() {
                let element = coarse.patches[0].refined.items[i];
                if let Some(c) = self.field.hardening(structure, element) {
                    coarse.harden(structure, element, &c);
                }
            }
        }
        coarse.spread(structure);
    }

    /// Whether the levels are to be drawn after nodes that were led on.
    pub(super) fn draws(&self) -> bool {
        !self.drawn.is_empty() && !self.carried && self.contacts.nodes.is_empty()
    }

    /// Loads level 1 with the pull of contacts that have come off and are expected to press again.
    pub(super) fn pull(&mut self, u: &[Vec3]) {
        let (structure, coarse, fixed) = (&self.structure, &mut self.coarse, &self.field.fixed);
        self.contacts.expected(u, |sample, depth, kappa, n| {
            for (&node, w) in sample.nodes.iter().zip(sample.weights) {
                if depth < 0.0 && !fixed[node as usize] {
                    coarse.draw(structure, node, &(n * (w * kappa * depth)));
                }
            }
        });
    }
}

impl Field {
    /// C of an element of level 1, if it has hardened since it was at rest.
    fn hardening(&mut self, structure: &Structure, element: u32) -> Option<Matrix3<f32>> {
        let (mut now, mut rest) = ([0.0; 6], [0.0; 6]);
        for &brick in structure.levels[0].children.row(element) {
            let firm = self.firm[brick as usize];
            // Zero: of this brick no blocks were asked for yet.
            if firm != [0.0; 6] {
                let at_rest = self.firm_at_rest(structure, brick);
                for e in 0..6 {
                    now[e] += firm[e];
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
    /// Makes an element of level 1 as much stiffer as `c` says.
    fn harden(&mut self, structure: &Structure, element: u32, c: &Matrix3<f32>) {
        let level = &structure.levels[0];
        let (corners, own) = level.element(element);
        let patch = &mut self.patches[0];
        patch.overlay(level, element, |k| {
            for (p, q) in (0..64).map(|i| (i / 8, i % 8)) {
                let block = Matrix3::from_fn(|a, b| own.k.get(at(p, a), lane(q, b)));
                let more = c * block * c - block;
                for (a, b) in (0..9).map(|i| (i / 3, i % 3)) {
                    k.0[at(p, a)][lane(q, b)] += more[(a, b)];
                }
            }
        });
        for (&point, bound) in corners.iter().zip(&own.bound) {
            let block = full(bound);
            let m = c * block * c - block;
            let more = [m.m11, m.m22, m.m33, m.m12, m.m13, m.m23];
            patch.bear(point, &more, 1.0);
        }
    }
}

/// A symmetric matrix of its entries xx, yy, zz, xy, xz, yz.
fn full<T: nalgebra::Scalar + Copy>(m: &[T; 6]) -> Matrix3<T> {
    Matrix3::new(m[0], m[3], m[4], m[3], m[1], m[5], m[4], m[5], m[2])
}

/// The positive root of a positive symmetric matrix (Denman and Beavers 1976: nothing but inverses, so that all
/// machines agree); none of any other.
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
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_root_times_itself_is_what_it_is_of(
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
    fn what_is_not_positive_has_no_root() {
        assert!(root(&[-1.0, 2.0, 3.0, 0.0, 0.0, 0.0]).is_none());
        assert!(root(&[f64::NAN; 6]).is_none());
        assert!(root(&[0.0; 6]).is_none_or(|r| r.iter().all(|v| v.abs() < 1e-2)));
    }
}
