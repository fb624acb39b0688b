//! Conjugate directions around the iterations of a full solve.
//!
//! Where a stiff layer lies on soft tissue, the coarse levels resist its bending too much, and an iteration leaves most of that
//! error. Therefore the energy is then minimised over the moves z of the iteration and the direction s before it (locally
//! optimal conjugate gradients, Knyazev 2001):
//!
//! ```text
//! zᵀKz a + zᵀKs b = zᵀr,    sᵀKz a + sᵀKs b = sᵀr,    u ← u + t (a z + b s)
//! ```
//!
//! Kz is the change of the brick forces over the iteration, so no force is evaluated for it. Contacts add their present
//! stiffness, and a line search for t takes them exactly. A new active set starts again, because its deferred forces change
//! without a move.
//!
//! Quick steps do without: they make few iterations with one set, and deep presses diverged.

use super::fine_level::FineLevel;
use super::quad::{Quad, plus};
use super::solver::Solver;
use crate::Vec3;

/// Bounds of t.
const SHARES: [f64; 2] = [0.0, 1.0];
/// Determinant, relative to the product of the diagonal, below which z and s count as parallel.
const PARALLEL: f64 = 1e-6;

/// The last iteration over the present active set. All lists follow the order of the set's nodes.
#[derive(Default)]
pub(super) struct Conjugate {
    /// Displacement and brick force at the start of the iteration.
    start: Vec<(Vec3, Quad)>,
    /// s and Ks.
    along: Vec<Move>,
}

/// Displacement of a node in m, and the brick force that it takes away in N.
#[derive(Default, Clone, Copy)]
struct Move {
    by: Vec3,
    force: Quad,
}

/// Sums over both directions: zᵀKz, zᵀKs and sᵀKs in N m, zᵀr and sᵀr in N m.
#[derive(Default)]
struct Sums {
    curvature: [f64; 3],
    work: [f64; 2],
}

impl Conjugate {
    /// Starts again: forces have changed without a move.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// z and Kz. Nodes on the rim of the set follow the coarse levels, and their forces are only half known.
    fn last_moves(&self, fine: &FineLevel, u: &[Vec3]) -> Vec<Move> {
        let nodes = fine.nodes.items.iter().map(|&node| node as usize);
        let moved = nodes.zip(&self.start).map(|(n, (from, force))| {
            if fine.free[n] && !fine.fixed[n] {
                Move {
                    by: u[n] - from,
                    force: plus(force, -1.0, &fine.r[n]),
                }
            } else {
                Move::default()
            }
        });
        moved.collect()
    }
}

impl Sums {
    /// The coefficients a and b.
    fn minimum(&self) -> [f64; 2] {
        let [zz, zs, ss] = self.curvature;
        let [z, s] = self.work;
        let determinant = zz * ss - zs * zs;
        if zz > 0.0 && ss > 0.0 && determinant > PARALLEL * zz * ss {
            [
                (z * ss - s * zs) / determinant,
                (s * zz - z * zs) / determinant,
            ]
        } else if zz > 0.0 {
            [z / zz, 0.0]
        } else {
            [0.0; 2]
        }
    }
}

fn work(force: &Quad, by: &Vec3) -> f64 {
    (0..3).map(|a| f64::from(force[a]) * by[a]).sum()
}

impl Solver {
    /// Stage: minimises the energy over the last iteration and the direction before it, and starts the next iteration.
    pub(super) fn conjugate(&mut self, u: &mut [Vec3]) {
        let mut conjugate = std::mem::take(&mut self.conjugate);
        self.fine.add_contacts(u, &self.contacts, -1.0);
        if !conjugate.start.is_empty() {
            let z = conjugate.last_moves(&self.fine, u);
            if conjugate.along.is_empty() {
                conjugate.along = vec![Move::default(); z.len()];
            }
            let s = &conjugate.along;
            let [a, b] = self.sums(u, &z, s).minimum();
            let mix = |z: &Move, s: &Move, a: f64, b: f64| Move {
                by: z.by * a + s.by * b,
                force: plus(&z.force.map(|f| a as f32 * f), b as f32, &s.force),
            };
            let direction: Vec<Move> = z.iter().zip(s).map(|(z, s)| mix(z, s, a, b)).collect();
            let t = self.move_along(u, &direction);
            let both = z.iter().zip(&direction);
            conjugate.along = both.map(|(z, d)| mix(z, d, 1.0, t)).collect();
        }
        let nodes = self.fine.nodes.items.iter().map(|&node| node as usize);
        conjugate.start = nodes.map(|n| (u[n], self.fine.r[n])).collect();
        self.fine.add_contacts(u, &self.contacts, 1.0);
        self.conjugate = conjugate;
    }

    /// The sums over z and s at brick forces `r`.
    fn sums(&self, u: &[Vec3], z: &[Move], s: &[Move]) -> Sums {
        let nodes = &self.fine.nodes.items;
        let mut sums = Sums::default();
        for ((&node, z), s) in nodes.iter().zip(z).zip(s) {
            let r = &self.fine.r[node as usize];
            let [zz, zs, ss] = &mut sums.curvature;
            *zz += work(&z.force, &z.by);
            *zs += 0.5 * (work(&s.force, &z.by) + work(&z.force, &s.by));
            *ss += work(&s.force, &s.by);
            sums.work[0] += work(r, &z.by);
            sums.work[1] += work(r, &s.by);
        }
        let of = |moves: &[Move], node: u32| {
            let place = nodes.binary_search(&node);
            place.map_or_else(|_| Vec3::zeros(), |i| moves[i].by)
        };
        self.contacts
            .pressed(u, |sample, force, stiffness, direction| {
                let (mut by_z, mut by_s) = (Vec3::zeros(), Vec3::zeros());
                for (&node, w) in sample.nodes.iter().zip(sample.weights) {
                    by_z += of(z, node) * w;
                    by_s += of(s, node) * w;
                }
                let (along_z, along_s) = (direction.dot(&by_z), direction.dot(&by_s));
                let products = [along_z * along_z, along_z * along_s, along_s * along_s];
                for (sum, product) in sums.curvature.iter_mut().zip(products) {
                    *sum += stiffness * product;
                }
                sums.work[0] += force.dot(&by_z);
                sums.work[1] += force.dot(&by_s);
            });
        sums
    }

    /// Moves the nodes along `direction` to the minimum of the energy; returns the step length. Brick forces follow
    /// linearly.
    fn move_along(&mut self, u: &mut [Vec3], direction: &[Move]) -> f64 {
        let nodes = std::mem::take(&mut self.fine.nodes.items);
        let (mut moved, mut before) = (Vec::new(), Vec::new());
        for (&node, step) in nodes.iter().zip(direction) {
            let r = &mut self.fine.r[node as usize];
            moved.push((node, step.by));
            before.push(*r);
            *r = plus(r, -1.0, &step.force);
            self.fine.shift(u, node, step.by);
        }
        let t = self.line_search(u, &moved, &before, [0.0; 2], SHARES).0;
        for ((&node, step), before) in nodes.iter().zip(direction).zip(&before) {
            self.fine.r[node as usize] = plus(before, -t as f32, &step.force);
            self.fine.shift(u, node, step.by * (t - 1.0));
        }
        self.fine.nodes.items = nodes;
        t
    }
}
