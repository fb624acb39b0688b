//! 3x3 blocks and vectors in four lanes of f32, for the coarse levels.
//!
//! A correction needs few digits, so the coarse levels run in single precision; the law itself and
//! the sum of the corrections do not.

use crate::equilibrium::law::{Symmetric, invert};

/// Three numbers and a lane that stays zero.
pub(crate) type Quad = [f32; 4];

/// Three columns.
pub(crate) type Block = [Quad; 3];

pub(crate) const ZERO: Quad = [0.0; 4];
pub(crate) const EMPTY: Block = [ZERO; 3];

/// `sum += block · v`.
#[inline]
pub(crate) fn accumulate(sum: &mut Quad, block: &Block, v: &Quad) {
    for l in 0..4 {
        sum[l] += block[0][l] * v[0] + block[1][l] * v[1] + block[2][l] * v[2];
    }
}

/// `to += scale · block`.
#[inline]
pub(crate) fn add_scaled(to: &mut Block, block: &Block, scale: f32) {
    for (column, source) in to.iter_mut().zip(block) {
        for l in 0..4 {
            column[l] += scale * source[l];
        }
    }
}

/// Inverse of a symmetric block.
pub(crate) fn inverse(block: &Block) -> Block {
    let m: Symmetric = [
        block[0][0],
        block[1][1],
        block[2][2],
        block[1][0],
        block[2][0],
        block[2][1],
    ]
    .map(f64::from);
    if m[0] + m[1] + m[2] <= 0.0 {
        return EMPTY;
    }
    let [xx, yy, zz, xy, xz, yz] = invert(&m).map(|v| v as f32);
    [[xx, xy, xz, 0.0], [xy, yy, yz, 0.0], [xz, yz, zz, 0.0]]
}

/// `scale · n nᵀ`.
#[inline]
pub(crate) fn outer(n: [f32; 3], scale: f32) -> Block {
    [0, 1, 2].map(|c| {
        let s = scale * n[c];
        [s * n[0], s * n[1], s * n[2], 0.0]
    })
}

/// Square of the length.
#[inline]
pub(crate) fn square(v: &Quad) -> f32 {
    v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
}
