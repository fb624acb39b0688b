//! Shares of Young's modulus for the springs of a cell that is no cube.
//!
//! A spring along the unit vector n with the share s of `springs.rs` gives a cell the energy ½ s E V (n·ε·n)²
//! under the uniform strain ε: the cell's stiffness is E Σ s n n n n. On a cube the shares make that isotropic.
//! On a distorted cell the same shares are anisotropic, which softens the whole: a bar at 30 degrees to the
//! lattice was 7 % too soft. So the shares are changed as little as possible until the tensor is isotropic
//! again (reconstructed). With A the 15 components of n n n n per spring, t those of the isotropic tensor and W
//! the shares of the cube,
//!
//! ```text
//! s = W + W Aᵀ (A W Aᵀ)⁻¹ (t - A W)
//! ```
//!
//! clamped between bounds, so that no spring ever pushes.

// Inlined into code for the vectors of this machine.
#![allow(clippy::inline_always)]

use pulp::Simd;

use crate::Vec3;
use crate::cell::PAIRS;
use crate::equilibrium::add_scaled;
use crate::springs::{BODY_SHARE, DIAGONAL_SHARE, EDGE_SHARE};

/// Springs of a cell: all pairs of its corners.
const SPRINGS: usize = PAIRS.len();

/// Bounds of a share, relative to the cube's.
const BOUNDS: [f64; 2] = [0.3, 4.0];
/// Rounds: each clamped share has to be compensated by the others.
const ROUNDS: usize = 4;
/// Regularisation relative to the trace: a cell so flat that some direction is missing stays nearly unchanged.
const REGULAR: f64 = 1e-6;
/// Deviation from a cube, in parts of its side, below which the shares are the cube's.
const CUBE: f64 = 1e-6;

/// Share of the spring between two corners of a cube.
pub(crate) const fn share(a: usize, b: usize) -> f64 {
    match (a ^ b).count_ones() {
        1 => EDGE_SHARE,
        2 => DIAGONAL_SHARE,
        _ => BODY_SHARE,
    }
}

/// Shares of the springs of a cell with these corners. A spring shorter than `floor` counts as that
/// long when its stiffness is computed, so it carries less than its share.
#[inline(always)]
pub(crate) fn shares<S: Simd>(simd: S, corners: &[Vec3; 8], floor: f64) -> [f64; SPRINGS] {
    let plain = PAIRS.map(|[a, b]| share(a, b));
    if is_cube(corners) {
        return plain;
    }
    let mut columns = [[0.0; ROW]; SPRINGS];
    for (column, [a, b]) in columns.iter_mut().zip(PAIRS) {
        let d = corners[b] - corners[a];
        let square = d.norm_squared();
        if square > 0.0 {
            let carried = (square / (floor * floor)).min(1.0);
            *column = powers(&(d / square.sqrt())).map(|v| v * carried);
        }
    }
    let mut shares = plain;
    let mut free = [true; SPRINGS];
    let mut normal = [[0.0; ROW]; COMPONENTS];
    for (column, share) in columns.iter().zip(plain) {
        add_square(simd, &mut normal, column, share);
    }
    for _ in 0..ROUNDS {
        let Some(factor) = factor(simd, &normal) else {
            break;
        };
        let force = solve(simd, &factor, missing(simd, &columns, &shares));
        let mut bounded = false;
        for s in 0..SPRINGS {
            if !free[s] {
                continue;
            }
            shares[s] += plain[s] * dot(&columns[s], &force);
            let [low, high] = BOUNDS.map(|b| b * plain[s]);
            if !(low..=high).contains(&shares[s]) {
                shares[s] = shares[s].clamp(low, high);
                free[s] = false;
                bounded = true;
                add_square(simd, &mut normal, &columns[s], -plain[s]);
            }
        }
        if !bounded {
            break;
        }
    }
    // Clamping can turn a good solution into a bad one, in cells that are nearly flat.
    let off = |shares| {
        let missing = missing(simd, &columns, shares);
        dot(&missing, &missing)
    };
    if off(&shares) < off(&plain) {
        shares
    } else {
        plain
    }
}

#[inline(always)]
fn is_cube(corners: &[Vec3; 8]) -> bool {
    let side = (corners[1] - corners[0]).norm();
    (0..8).all(|c| {
        let at = |bit: usize| (c >> bit & 1) as f64 * side;
        let d = corners[c] - corners[0] - Vec3::new(at(0), at(1), at(2));
        d.norm() <= CUBE * side
    })
}

/// Components of a fourth-order tensor that are summed over directions, padded with zeros to whole SIMD
/// vectors.
const COMPONENTS: usize = 15;
const ROW: usize = 16;
type Row = [f64; ROW];
type Matrix = [Row; COMPONENTS];

/// The components of n n n n.
#[inline(always)]
fn powers(n: &Vec3) -> Row {
    let [x, y, z] = [n.x, n.y, n.z];
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        xx * xx,
        yy * yy,
        zz * zz,
        xx * yy,
        xx * zz,
        yy * zz,
        xx * x * y,
        xx * x * z,
        yy * y * x,
        yy * y * z,
        zz * z * x,
        zz * z * y,
        xx * y * z,
        yy * x * z,
        zz * x * y,
        0.0,
    ]
}

/// Those of 0.4 (δδ + δδ + δδ): the tensor of springs with E = 1 and Poisson's ratio 1/4.
const ISOTROPIC: Row = {
    let mut t = [0.0; ROW];
    let mut i = 0;
    while i < 3 {
        t[i] = 1.2;
        t[3 + i] = 0.4;
        i += 1;
    }
    t
};

/// Isotropic tensor minus the tensor of these shares.
#[inline(always)]
fn missing<S: Simd>(simd: S, columns: &[Row; SPRINGS], shares: &[f64; SPRINGS]) -> Row {
    let mut sum = ISOTROPIC;
    for (column, share) in columns.iter().zip(shares) {
        add_scaled(simd, &mut sum, -share, column);
    }
    sum
}

/// `to += weight c cᵀ`.
#[inline(always)]
fn add_square<S: Simd>(simd: S, to: &mut Matrix, c: &Row, weight: f64) {
    for (row, v) in to.iter_mut().zip(c) {
        add_scaled(simd, row, weight * v, c);
    }
}

/// Sum of the products, in an order that suits vectors of any width.
#[inline(always)]
fn dot(a: &Row, b: &Row) -> f64 {
    let mut sum = [0.0; ROW];
    for i in 0..ROW {
        sum[i] = a[i] * b[i];
    }
    let mut half = ROW / 2;
    while half > 0 {
        for i in 0..half {
            sum[i] += sum[i + half];
        }
        half /= 2;
    }
    sum[0]
}

/// Cholesky factor U of the regularised matrix Uᵀ U; `None` if that is not positive definite.
#[inline(always)]
fn factor<S: Simd>(simd: S, normal: &Matrix) -> Option<Matrix> {
    let trace: f64 = (0..COMPONENTS).map(|i| normal[i][i]).sum();
    let mut u = *normal;
    for i in 0..COMPONENTS {
        u[i][i] += REGULAR * trace;
    }
    for i in 0..COMPONENTS {
        let root = u[i][i].sqrt();
        if root.is_nan() || root <= 0.0 {
            return None;
        }
        u[i][..i].fill(0.0);
        let per_root = 1.0 / root;
        let row = u[i].map(|v| v * per_root);
        u[i] = row;
        for (below, v) in u.iter_mut().zip(row).skip(i + 1) {
            add_scaled(simd, below, -v, &row);
        }
    }
    Some(u)
}

/// Solves Uᵀ U x = b.
#[inline(always)]
fn solve<S: Simd>(simd: S, u: &Matrix, mut b: Row) -> Row {
    for (i, row) in u.iter().enumerate() {
        let v = b[i] / row[i];
        add_scaled(simd, &mut b, -v, row);
        b[i] = v;
    }
    for (i, row) in u.iter().enumerate().rev() {
        let v = std::mem::take(&mut b[i]);
        b[i] = (v - dot(row, &b)) / row[i];
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Distance of the tensor of these shares from the isotropic one.
    fn off(corners: &[Vec3; 8], shares: &[f64; SPRINGS]) -> f64 {
        let columns = PAIRS.map(|[a, b]| powers(&(corners[b] - corners[a]).normalize()));
        missing(pulp::Scalar::new(), &columns, shares)
            .iter()
            .map(|v| v * v)
            .sum::<f64>()
            .sqrt()
    }

    fn cube() -> [Vec3; 8] {
        std::array::from_fn(|c| Vec3::new((c & 1) as f64, (c >> 1 & 1) as f64, (c >> 2) as f64))
    }

    #[test]
    fn cube_is_isotropic_with_its_own_shares() {
        let shares = shares(pulp::Scalar::new(), &cube(), 0.5);
        assert_eq!(shares, PAIRS.map(|[a, b]| share(a, b)));
        assert!(off(&cube(), &shares) < 1e-12);
    }

    #[test]
    fn slightly_distorted_cell_becomes_isotropic() {
        let mut corners = cube();
        corners[7] += Vec3::new(0.1, -0.05, 0.1);
        corners[2] += Vec3::new(-0.1, 0.1, 0.05);
        let off = |s| off(&corners, s);
        let plain = PAIRS.map(|[a, b]| share(a, b));
        let fitted = shares(pulp::Scalar::new(), &corners, 0.1);
        assert!(
            off(&fitted) < 0.02 * off(&plain),
            "{} {}",
            off(&fitted),
            off(&plain)
        );
    }

    proptest! {
        #[test]
        fn distorted_cells_approach_isotropy_with_non_negative_shares(
            moves in prop::array::uniform24(-0.2..0.2f64)
        ) {
            let mut corners = cube();
            for (c, corner) in corners.iter_mut().enumerate() {
                *corner += Vec3::new(moves[3 * c], moves[3 * c + 1], moves[3 * c + 2]);
            }
            let plain = PAIRS.map(|[a, b]| share(a, b));
            let fitted = shares(pulp::Scalar::new(), &corners, 0.1);
            let off = |s| off(&corners, s);
            prop_assert!(off(&fitted) <= off(&plain) + 1e-9, "{} {}", off(&fitted), off(&plain));
            prop_assert!(fitted.iter().all(|s| *s > 0.0));
        }
    }
}
