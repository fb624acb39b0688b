//! Elements of the coarse levels: 24 x 24 stiffness matrices over eight points.
//!
//! Galerkin coarse operator: with u = P e, P the trilinear weights, the energy at rest becomes ½ eᵀ(PᵀAP)e. For coarse
//! point I a spring between nodes i and j has the weight `d_I = w_jI - w_iI`, so it adds
//!
//! ```text
//! k [n nᵀ + σ (I - n nᵀ)] d_I d_J
//! ```
//!
//! A spring at rest has σ = 0. Here σ is a small part of the floor of `law.rs`, so that weakly connected points are not
//! singular. It is small because it resists rotations: with the whole floor tissue that turns about a bone was four
//! times too stiff on the coarse levels, and distant tissue never converged. The volume term of a cell adds κ V0 b bᵀ
//! with b = Σ w ∇J. Matrices are stored per element, not assembled in rows, so a cut changes no table of neighbours.
//! Equal elements (the inside of every homogeneous region) share one matrix.

use pulp::Simd;

use super::brick::{CORNER, Form, LOCALS, OFFSETS};
use super::lanes::add_scaled;
use super::law::{Symmetric, sideways};
use super::matrix::{Matrix, SIZE, at};

/// σ relative to the floor of `law.rs`.
const TURNING: f64 = 0.1;
/// Stiffness of a corner, relative to the stiffest one of its element, below which it is tied to the others. Otherwise
/// a point beside a bone that carries an eighth of one soft node was corrected by 250 mm, and the line search accepted
/// almost nothing. Values from 0.003 to 0.1 all work.
const WEAK: f64 = 0.03;
/// Power iterations for the largest eigenvalue of a scaled element.
const POWER: usize = 12;

/// Dense matrix of an element.
pub(super) type Dense = [[f64; SIZE]; SIZE];

/// Pairs of corners, equal ones included.
const CORNER_PAIRS: usize = 36;
/// Numbers of a symmetric block, padded to a vector.
const BLOCK: usize = 8;

/// Accumulates a [`Matrix`] in f64.
pub(crate) struct Sum {
    dense: Box<Dense>,
    /// Blocks xx, yy, zz, xy, xz, yz of the springs by pairs of corners (q, p), q <= p.
    springs: Box<[[f64; BLOCK]; CORNER_PAIRS]>,
}

impl Sum {
    pub(crate) fn new() -> Self {
        Self {
            dense: Box::new([[0.0; SIZE]; SIZE]),
            springs: Box::new([[0.0; BLOCK]; CORNER_PAIRS]),
        }
    }

    /// Adds the springs and volume terms of a brick; bit `i` of `fixed` marks entry `i` as fixed.
    #[inline(always)]
    pub(crate) fn add_brick<S: Simd>(
        &mut self,
        simd: S,
        form: &Form,
        fixed: u32,
        per_spacing: f32,
    ) {
        for (direction, offset) in OFFSETS.into_iter().enumerate() {
            for (i, &k) in form.stiffness[direction][..LOCALS].iter().enumerate() {
                if k > 0.0 {
                    let k = f64::from(k);
                    self.add_spring(simd, form, [i, i + offset], k, fixed, per_spacing);
                }
            }
        }
        if form.has_bulk {
            self.add_bulk(simd, form, fixed);
        }
    }

    #[inline(always)]
    fn add_spring<S: Simd>(
        &mut self,
        simd: S,
        form: &Form,
        [i, j]: [usize; 2],
        k: f64,
        fixed: u32,
        per_spacing: f32,
    ) {
        let moves = |entry: usize| f64::from(1 - (fixed >> entry & 1));
        let (mi, mj) = (moves(i), moves(j));
        let d: [f64; 8] = std::array::from_fn(|c| mj * WEIGHTS[j][c] - mi * WEIGHTS[i][c]);
        let block = spring_block(form, [i, j], k, per_spacing);
        let mut pair = 0;
        for p in 0..8 {
            if d[p] != 0.0 {
                for q in 0..=p {
                    let w = d[p] * d[q];
                    if w != 0.0 {
                        add_scaled(simd, &mut self.springs[pair + q], w, &block);
                    }
                }
            }
            pair += p + 1;
        }
    }

    /// Adds the blocks of the springs to the dense matrix.
    #[inline(always)]
    fn add_springs(&mut self) {
        let mut pair = 0;
        for p in 0..8 {
            for q in 0..=p {
                let [xx, yy, zz, xy, xz, yz, ..] = self.springs[pair];
                let block = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
                for (a, b) in (0..9).map(|i| (i / 3, i % 3)) {
                    self.dense[at(p, a)][at(q, b)] += block[a][b];
                    if p != q {
                        self.dense[at(q, b)][at(p, a)] += block[a][b];
                    }
                }
                pair += 1;
            }
        }
    }

    #[inline(always)]
    fn add_bulk<S: Simd>(&mut self, simd: S, form: &Form, fixed: u32) {
        for corners in CORNER {
            let cell = corners[0];
            if form.bulk[cell] == 0.0 {
                continue;
            }
            let gradients = volume_gradients(form, &corners);
            let mut b = [0.0; SIZE];
            for c in 0..8 {
                let entry = corners[c];
                if fixed >> entry & 1 == 1 {
                    continue;
                }
                for a in 0..3 {
                    for p in 0..8 {
                        b[at(p, a)] += WEIGHTS[entry][p] * gradients[c][a];
                    }
                }
            }
            let k = f64::from(form.bulk[cell]);
            for (i, row) in self.dense.iter_mut().enumerate() {
                add_scaled(simd, row, k * b[i], &b);
            }
        }
    }

    /// Adds the matrix of a finer element at octant `octant` of this one.
    #[inline(always)]
    pub(crate) fn add_child<S: Simd>(&mut self, simd: S, child: &Matrix, octant: usize) {
        let mut k = child.dense();
        // The weights are products of weights per axis, so that Pᵀ K takes three passes. K is symmetric.
        restrict(simd, &mut k, octant);
        let mut k = transposed(&k);
        restrict(simd, &mut k, octant);
        for (to, row) in self.dense.iter_mut().zip(&k) {
            add_scaled(simd, to, 1.0, row);
        }
    }

    /// The matrix and its bound. Homogeneous elements (`alike`) stay in single precision: these few matrices fit in the
    /// L1 cache.
    #[inline(always)]
    pub(crate) fn finish<S: Simd>(mut self, simd: S, alike: bool) -> Matrix {
        self.add_springs();
        self.tie_weak_corners();
        let k = &*self.dense;
        let blocks: [Symmetric; 8] = std::array::from_fn(|c| {
            let k = |a: usize, b: usize| k[at(c, a)][at(c, b)];
            [k(0, 0), k(1, 1), k(2, 2), k(0, 1), k(0, 2), k(1, 2)]
        });
        let largest = largest(simd, k, &blocks);
        let bound = blocks.map(|b| b.map(|v| (v * largest) as f32));
        Matrix::new(k, bound, alike)
    }

    /// Ties weakly connected corners to the others, like a soft filling. Rigid translations still make no force.
    #[inline(always)]
    fn tie_weak_corners(&mut self) {
        let own = |c: usize| (0..3).map(|a| self.dense[at(c, a)][at(c, a)]).sum::<f64>() / 3.0;
        let own: [f64; 8] = std::array::from_fn(own);
        let least = WEAK * own.iter().copied().fold(0.0, f64::max);
        let strong: Vec<usize> = (0..8).filter(|&c| own[c] >= least).collect();
        for c in (0..8).filter(|&c| own[c] > 0.0 && own[c] < least) {
            let k = (least - own[c]) / strong.len() as f64;
            for &other in &strong {
                for (i, j) in (0..3).map(|a| (at(c, a), at(other, a))) {
                    self.dense[i][i] += k;
                    self.dense[j][j] += k;
                    self.dense[i][j] -= k;
                    self.dense[j][i] -= k;
                }
            }
        }
    }
}

/// The matrix of a spring of stiffness `k` at rest: xx, yy, zz, xy, xz, yz, padded.
#[inline(always)]
pub(super) fn spring_block(
    form: &Form,
    [i, j]: [usize; 2],
    k: f64,
    per_spacing: f32,
) -> [f64; BLOCK] {
    let v: [f64; 3] =
        std::array::from_fn(|a| f64::from(form.rest[a][j]) - f64::from(form.rest[a][i]));
    let square = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).max(1e-20);
    let floor = TURNING * f64::from(sideways(square.sqrt() as f32, per_spacing));
    let (along, all) = (k * (1.0 - floor) / square, k * floor);
    [
        along * v[0] * v[0] + all,
        along * v[1] * v[1] + all,
        along * v[2] * v[2] + all,
        along * v[0] * v[1],
        along * v[0] * v[2],
        along * v[1] * v[2],
        0.0,
        0.0,
    ]
}

/// Gradients of the relative volume of a cell at rest by the positions of its corners, in 1/m.
#[inline(always)]
pub(super) fn volume_gradients(form: &Form, corners: &[usize; 8]) -> [[f64; 3]; 8] {
    let point = |c: usize, a: usize| f64::from(form.rest[a][corners[c]]);
    let sign = |c: usize, axis: usize| if c >> axis & 1 == 1 { 1.0 } else { -1.0 };
    let edge: [[f64; 3]; 3] = std::array::from_fn(|axis| {
        std::array::from_fn(|a| (0..8).map(|c| sign(c, axis) * point(c, a)).sum::<f64>() / 4.0)
    });
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    };
    let normals = [
        cross(edge[1], edge[2]),
        cross(edge[2], edge[0]),
        cross(edge[0], edge[1]),
    ];
    let scale = f64::from(form.per_volume[corners[0]]) / 4.0;
    std::array::from_fn(|c| {
        std::array::from_fn(|a| {
            (0..3)
                .map(|axis| sign(c, axis) * (normals[axis][a] * scale))
                .sum()
        })
    })
}

/// `Pᵀ K`, with the interpolation from a parent to its child at an octant.
#[inline(always)]
fn restrict<S: Simd>(simd: S, k: &mut Dense, octant: usize) {
    for axis in 0..3 {
        for low in (0..8).filter(|c| c >> axis & 1 == 0) {
            for a in 0..3 {
                let (mut end, mut middle) = (at(low, a), at(low | 1 << axis, a));
                if octant >> axis & 1 == 1 {
                    std::mem::swap(&mut end, &mut middle);
                }
                // The middle of the axis belongs to both ends by half.
                let mut half = [0.0; SIZE];
                add_scaled(simd, &mut half, 0.5, &k[middle]);
                add_scaled(simd, &mut k[end], 1.0, &half);
                k[middle] = half;
            }
        }
    }
}

/// Not inlined: vector gathers are slower than these copies.
#[inline(never)]
fn transposed(k: &Dense) -> Dense {
    let mut to = [[0.0; SIZE]; SIZE];
    for (i, row) in to.iter_mut().enumerate() {
        for (v, column) in row.iter_mut().zip(k) {
            *v = column[i];
        }
    }
    to
}

/// Largest eigenvalue of an element scaled by the inverse of its diagonal blocks.
#[inline(always)]
fn largest<S: Simd>(simd: S, k: &Dense, blocks: &[Symmetric; 8]) -> f64 {
    let inverse = blocks.map(|b| {
        if b[0] + b[1] + b[2] > 0.0 {
            super::law::invert(&b)
        } else {
            [0.0; 6]
        }
    });
    // A fixed start that is orthogonal to no likely eigenvector.
    let mut x: [f64; SIZE] = std::array::from_fn(|i| ((i * 37 + 11) % 29) as f64 / 29.0 - 0.4);
    let mut value = 1.0;
    for _ in 0..POWER {
        let mut y = [0.0; SIZE];
        for (column, x) in k.iter().zip(x) {
            add_scaled(simd, &mut y, x, column);
        }
        let mut z = [0.0; SIZE];
        for c in 0..8 {
            let (m, v) = (&inverse[c], [y[at(c, 0)], y[at(c, 1)], y[at(c, 2)]]);
            z[at(c, 0)] = m[0] * v[0] + m[3] * v[1] + m[4] * v[2];
            z[at(c, 1)] = m[3] * v[0] + m[1] * v[1] + m[5] * v[2];
            z[at(c, 2)] = m[4] * v[0] + m[5] * v[1] + m[2] * v[2];
        }
        let (norm, before) = (norm(&z), norm(&x));
        if norm == 0.0 || before == 0.0 {
            break;
        }
        value = norm / before;
        x = z.map(|v| v / norm);
    }
    // Power iteration approaches the eigenvalue from below.
    (1.05 * value).clamp(1.0, 8.0)
}

/// Norm, with sums in an order that suits vectors of any width.
#[inline(always)]
fn norm(x: &[f64; SIZE]) -> f64 {
    let mut sums = [0.0; SIZE / 3];
    for part in x.chunks_exact(sums.len()) {
        for (sum, v) in sums.iter_mut().zip(part) {
            *sum += v * v;
        }
    }
    sums.iter().sum::<f64>().sqrt()
}

/// Trilinear weights of the eight corners at each of the 27 places of an element.
pub(crate) const WEIGHTS: [[f64; 8]; LOCALS] = weights();

const fn weights() -> [[f64; 8]; LOCALS] {
    let mut list = [[0.0; 8]; LOCALS];
    let mut i = 0;
    while i < LOCALS {
        let at = [i % 3, i / 3 % 3, i / 9];
        let mut c = 0;
        while c < 8 {
            let mut w = 1.0;
            let mut a = 0;
            while a < 3 {
                let high = at[a] as f64 * 0.5;
                w *= if c >> a & 1 == 1 { high } else { 1.0 - high };
                a += 1;
            }
            list[i][c] = w;
            c += 1;
        }
        i += 1;
    }
    list
}
