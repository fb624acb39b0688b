//! Krylov acceleration of full solves (Washio and Oosterlee 1997): conjugate directions, with the multigrid iteration as the
//! preconditioner.
//!
//! Coarse operators are too stiff in bending where a stiff layer lies on soft tissue: an iteration leaves 87 to 91 % of that
//! error. Before the next iteration the energy is therefore minimised over two directions, as in locally optimal conjugate
//! gradients (Knyazev 2001): z, the increment of the last iteration, and s, the whole increment of the one before it. With
//! the tangent stiffness K and the residual r after the last iteration:
//!
//! ```text
//! zᵀKz a + zᵀKs b = zᵀr,    zᵀKs a + sᵀKs b = sᵀr,    d = a z + b s,    u ← u + t d,    s ← z + t d
//! ```
//!
//! Kz is the decrease of the brick forces over the iteration (a secant). Contacts enter a and b with their current stiffness.
//! The line search for t evaluates contact forces exactly and interpolates brick forces between both ends of the step, as for
//! a coarse correction. Ties of a needle enter by groups of three nodes, which may underestimate their curvature threefold;
//! the line search bounds the effect. A change of the active set discards both directions, because nodal forces then change
//! without a displacement.
//!
//! Quick steps omit it: most of their error is that of deferred elements.

use super::fine_level::FineLevel;
use super::quad::{Quad, plus, work};
use super::solver::Solver;
use crate::Vec3;

/// Bounds of the step length t. Beyond 1 neither brick forces nor the model of the energy are known.
const STEP_LENGTHS: [f64; 2] = [0.0, 1.0];
/// Determinant, relative to the product of the diagonal, below which z and s count as linearly dependent: Kz has the digits
/// of f32.
const DEPENDENT_BELOW: f64 = 1e-6;

/// State of the last iteration, in the order of the active nodes.
#[derive(Default)]
pub(super) struct ConjugateDirections {
    /// Displacement and brick force at the start of the iteration.
    start: Vec<(Vec3, Quad)>,
    /// s and Ks.
    previous: Vec<Increment>,
}

/// Displacement increment of a node in m, and the decrease of its brick force in N.
#[derive(Default, Clone, Copy)]
struct Increment {
    by: Vec3,
    force: Quad,
}

impl Increment {
    /// `a` times this plus `b` times `other`.
    fn combine(&self, a: f64, other: &Self, b: f64) -> Self {
        Self {
            by: self.by * a + other.by * b,
            force: plus(&self.force.map(|f| a as f32 * f), b as f32, &other.force),
        }
    }
}

impl ConjugateDirections {
    /// z and Kz. Nodes on the rim count as unmoved: they follow the coarse levels, and some of their bricks are inactive.
    fn last_increment(&self, fine: &FineLevel, u: &[Vec3]) -> Vec<Increment> {
        let nodes = fine.nodes.items.iter().map(|&node| node as usize);
        let increment = nodes.zip(&self.start).map(|(n, (from, force))| {
            if fine.free[n] {
                Increment {
                    by: u[n] - from,
                    force: plus(force, -1.0, &fine.r[n]),
                }
            } else {
                Increment::default()
            }
        });
        increment.collect()
    }
}

/// The coefficients a and b, from zᵀKz, zᵀKs, sᵀKs, zᵀr and sᵀr.
fn minimum([zz, zs, ss, zr, sr]: [f64; 5]) -> [f64; 2] {
    let determinant = zz * ss - zs * zs;
    if zz > 0.0 && determinant > DEPENDENT_BELOW * zz * ss {
        [
            (zr * ss - sr * zs) / determinant,
            (sr * zz - zr * zs) / determinant,
        ]
    } else if zz > 0.0 {
        [zr / zz, 0.0]
    } else {
        [0.0; 2]
    }
}

impl Solver {
    /// Stage: minimises the energy over z and s, then records the start of the next iteration.
    pub(super) fn conjugate(&mut self, u: &mut [Vec3]) {
        self.fine.add_contacts(u, &self.contacts, -1.0);
        if !self.conjugate.start.is_empty() {
            let z = self.conjugate.last_increment(&self.fine, u);
            let previous = &mut self.conjugate.previous;
            previous.resize(z.len(), Increment::default());
            let s = &self.conjugate.previous;
            let [a, b] = minimum(self.products(u, &z, s));
            let mut step: Vec<_> = z.iter().zip(s).map(|(z, s)| z.combine(a, s, b)).collect();
            let t = self.move_along(u, &mut step);
            let both = z.iter().zip(&step);
            self.conjugate.previous = both.map(|(z, d)| z.combine(1.0, d, t)).collect();
        }
        let nodes = self.fine.nodes.items.iter().map(|&node| node as usize);
        self.conjugate.start = nodes.map(|n| (u[n], self.fine.r[n])).collect();
        self.fine.add_contacts(u, &self.contacts, 1.0);
    }

    /// zᵀKz, zᵀKs, sᵀKs, zᵀr and sᵀr in N m, with contacts.
    fn products(&self, u: &[Vec3], z: &[Increment], s: &[Increment]) -> [f64; 5] {
        let nodes = &self.fine.nodes.items;
        let mut sums = [0.0; 5];
        let mut add = |terms: [f64; 5]| {
            for (sum, term) in sums.iter_mut().zip(terms) {
                *sum += term;
            }
        };
        for ((&node, z), s) in nodes.iter().zip(z).zip(s) {
            let r = &self.fine.r[node as usize];
            // Secants are not symmetric in their two directions.
            let zs = 0.5 * (work(&s.force, &z.by) + work(&z.force, &s.by));
            let [zz, ss] = [z, s].map(|v| work(&v.force, &v.by));
            add([zz, zs, ss, work(r, &z.by), work(r, &s.by)]);
        }
        let of = |increments: &[Increment], node: u32| {
            let found = nodes.binary_search(&node);
            found.map_or_else(|_| Vec3::zeros(), |i| increments[i].by)
        };
        self.contacts.pressed(u, |sample, force, k, normal| {
            let [z, s] = [z, s].map(|increments| {
                let weighted = sample.nodes.iter().zip(sample.weights);
                let each = weighted.map(|(&node, w)| of(increments, node) * w);
                each.sum::<Vec3>()
            });
            let (nz, ns) = (normal.dot(&z), normal.dot(&s));
            let stiff = [k * nz * nz, k * nz * ns, k * ns * ns];
            add([stiff[0], stiff[1], stiff[2], force.dot(&z), force.dot(&s)]);
        });
        sums
    }

    /// Moves the nodes along `step` to the minimum of the energy, and sets its decrease of the brick forces; returns the step
    /// length.
    fn move_along(&mut self, u: &mut [Vec3], step: &mut [Increment]) -> f64 {
        let nodes = self.fine.nodes.items.iter();
        let moved: Vec<_> = nodes.zip(&*step).map(|(&n, step)| (n, step.by)).collect();
        let before: Vec<Quad> = moved.iter().map(|m| self.fine.r[m.0 as usize]).collect();
        let displaced = self.fine.displaced;
        self.fine.add_increments(u, &moved, 1.0);
        self.fine.evaluate_bricks(&self.hierarchy, u);
        let t = self.line_search(u, &moved, &before, [0.0; 2], STEP_LENGTHS);
        for (((node, _), before), step) in moved.iter().zip(&before).zip(step) {
            let r = &mut self.fine.r[*node as usize];
            step.force = plus(before, -1.0, r);
            *r = plus(before, -t as f32, &step.force);
        }
        // A step that the line search shortens must not widen the search for contacts.
        self.fine.add_increments(u, &moved, -1.0);
        self.fine.displaced = displaced;
        self.fine.add_increments(u, &moved, t);
        t
    }
}
