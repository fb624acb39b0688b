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
use crate::equilibrium::Wide;
use crate::springs::{BODY_SHARE, DIAGONAL_SHARE, EDGE_SHARE};

/// Springs of a cell: all pairs of its corners.
const SPRINGS: usize = PAIRS.len();
/// Cells that are fitted together, one per lane.
pub(crate) const CELLS: usize = 8;

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

/// Shares of the springs of cells with these corners, by spring and cell. A spring shorter than `floor` counts as that
/// long when its stiffness is computed, so it carries less than its share.
#[inline(always)]
pub(crate) fn shares<S: Simd>(
    simd: S,
    cells: &[[Vec3; 8]; CELLS],
    floor: f64,
) -> [[f64; CELLS]; SPRINGS] {
    let mut shares = PAIRS.map(|[a, b]| [share(a, b); CELLS]);
    let mut fitted = [false; CELLS];
    let mut corners = [[[0.0; CELLS]; 3]; 8];
    for (l, cell) in cells.iter().enumerate() {
        fitted[l] = !is_cube(cell);
        for (to, corner) in corners.iter_mut().zip(cell) {
            for a in 0..3 {
                to[a][l] = corner[a];
            }
        }
    }
    let mut from = 0;
    while from < CELLS {
        let until = from + Wide::<S>::WIDTH;
        if fitted[from..until].contains(&true) {
            let fit = Fit::new(simd, &corners, from, floor).shares();
            for (to, fit) in shares.iter_mut().zip(fit) {
                let mut lanes = [0.0; CELLS];
                fit.store(&mut lanes, from);
                for l in (from..until).filter(|&l| fitted[l]) {
                    to[l] = lanes[l];
                }
            }
        }
        from = until;
    }
    shares
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

/// Components of a fourth-order tensor that are summed over directions.
const COMPONENTS: usize = 15;

/// Those of 0.4 (δδ + δδ + δδ): the tensor of springs with E = 1 and Poisson's ratio 1/4.
const ISOTROPIC: [f64; COMPONENTS] = {
    let mut t = [0.0; COMPONENTS];
    let mut i = 0;
    while i < 3 {
        t[i] = 1.2;
        t[3 + i] = 0.4;
        i += 1;
    }
    t
};

/// The components of n n n n.
#[inline(always)]
fn powers<S: Simd>([x, y, z]: [Wide<S>; 3]) -> [Wide<S>; COMPONENTS] {
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
    ]
}

type Row<S> = [Wide<S>; COMPONENTS];
/// A symmetric matrix, or its Cholesky factor, of which the part from the diagonal on is in use.
type Matrix<S> = [Row<S>; COMPONENTS];

/// The cells of one vector, one per lane: every operation is that of a single cell.
struct Fit<S: Simd> {
    simd: S,
    /// A: per spring the tensor of a share of one.
    columns: [Row<S>; SPRINGS],
}

impl<S: Simd> Fit<S> {
    #[inline(always)]
    fn new(simd: S, corners: &[[[f64; CELLS]; 3]; 8], from: usize, floor: f64) -> Self {
        let (zero, one) = (Wide::all(simd, 0.0), Wide::all(simd, 1.0));
        let floor = Wide::all(simd, floor * floor);
        let mut columns = [[zero; COMPONENTS]; SPRINGS];
        for (column, [a, b]) in columns.iter_mut().zip(PAIRS) {
            let mut d = [zero; 3];
            for axis in 0..3 {
                let start = Wide::load(simd, &corners[a][axis], from);
                d[axis] = Wide::load(simd, &corners[b][axis], from) - start;
            }
            let square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            // A spring without length carries nothing.
            let length = zero.where_below(square, square.sqrt(), one);
            let carried = square / floor;
            let carried = carried.where_below(one, carried, one);
            let powers = powers([d[0] / length, d[1] / length, d[2] / length]);
            for (to, v) in column.iter_mut().zip(powers) {
                *to = v * carried;
            }
        }
        Self { simd, columns }
    }

    #[inline(always)]
    fn all(&self, value: f64) -> Wide<S> {
        Wide::all(self.simd, value)
    }

    #[inline(always)]
    fn shares(&self) -> [Wide<S>; SPRINGS] {
        let (zero, one) = (self.all(0.0), self.all(1.0));
        let mut plain = [zero; SPRINGS];
        for (plain, [a, b]) in plain.iter_mut().zip(PAIRS) {
            *plain = self.all(share(a, b));
        }
        let mut shares = plain;
        let mut missing = self.missing(&shares);
        let off = self.dot(&missing, &missing);
        let mut normal = self.normal(&plain);
        // One in lanes whose shares change still, and where a share is not clamped yet.
        let (mut live, mut free) = (one, [one; SPRINGS]);
        for _ in 0..ROUNDS {
            let (factor, sound) = self.factor(&normal);
            live = live * sound;
            let force = Self::solve(&factor, missing);
            let mut bounded = zero;
            for s in 0..SPRINGS {
                let changes = live * free[s];
                let share = shares[s] + plain[s] * self.dot(&self.columns[s], &force);
                let (low, high) = (
                    self.all(BOUNDS[0]) * plain[s],
                    self.all(BOUNDS[1]) * plain[s],
                );
                let clamped = share.where_below(low, low, share);
                let clamped = high.where_below(share, high, clamped);
                shares[s] = zero.where_below(changes, clamped, shares[s]);
                // Also where it is not a number.
                let exceeds = share.where_below(low, one, zero);
                let exceeds = high.where_below(share, one, exceeds);
                let now = changes * exceeds;
                if now.any_above_zero() {
                    free[s] = free[s] - now;
                    bounded = zero.where_below(now, one, bounded);
                    self.add_square(&mut normal, s, zero - plain[s] * now);
                }
            }
            live = live * bounded;
            missing = self.missing(&shares);
            if !live.any_above_zero() {
                break;
            }
        }
        // Clamping can turn a good solution into a bad one, in cells that are nearly flat.
        let off_now = self.dot(&missing, &missing);
        for (share, plain) in shares.iter_mut().zip(plain) {
            *share = off_now.where_below(off, *share, plain);
        }
        shares
    }

    /// Isotropic tensor minus the tensor of these shares.
    #[inline(always)]
    fn missing(&self, shares: &[Wide<S>; SPRINGS]) -> Row<S> {
        let mut sum = [self.all(0.0); COMPONENTS];
        for (sum, t) in sum.iter_mut().zip(ISOTROPIC) {
            *sum = self.all(t);
        }
        for (column, share) in self.columns.iter().zip(shares) {
            for (sum, v) in sum.iter_mut().zip(column) {
                *sum = *sum - *share * *v;
            }
        }
        sum
    }

    /// A W Aᵀ.
    #[inline(always)]
    fn normal(&self, weights: &[Wide<S>; SPRINGS]) -> Matrix<S> {
        let zero = self.all(0.0);
        let mut normal = [[zero; COMPONENTS]; COMPONENTS];
        for (i, row) in normal.iter_mut().enumerate() {
            let mut weighted = [zero; SPRINGS];
            for s in 0..SPRINGS {
                weighted[s] = weights[s] * self.columns[s][i];
            }
            for (j, to) in row.iter_mut().enumerate().skip(i) {
                let mut sum = zero;
                for s in 0..SPRINGS {
                    sum = sum + weighted[s] * self.columns[s][j];
                }
                *to = sum;
            }
        }
        normal
    }

    /// `to += weight c cᵀ` with the column c of a spring.
    #[inline(always)]
    fn add_square(&self, to: &mut Matrix<S>, spring: usize, weight: Wide<S>) {
        let c = &self.columns[spring];
        for (i, row) in to.iter_mut().enumerate() {
            let weighted = weight * c[i];
            for (to, v) in row.iter_mut().zip(c).skip(i) {
                *to = *to + weighted * *v;
            }
        }
    }

    /// Sum of the products, by halves.
    #[inline(always)]
    fn dot(&self, a: &Row<S>, b: &Row<S>) -> Wide<S> {
        let mut sum = [self.all(0.0); COMPONENTS + 1];
        for i in 0..COMPONENTS {
            sum[i] = a[i] * b[i];
        }
        let mut half = sum.len() / 2;
        while half > 0 {
            for i in 0..half {
                sum[i] = sum[i] + sum[i + half];
            }
            half /= 2;
        }
        sum[0]
    }

    /// Cholesky factor U of the regularised matrix Uᵀ U, and one in the lanes where that is positive definite, else zero.
    #[inline(always)]
    fn factor(&self, normal: &Matrix<S>) -> (Matrix<S>, Wide<S>) {
        let (zero, one) = (self.all(0.0), self.all(1.0));
        let mut trace = zero;
        for i in 0..COMPONENTS {
            trace = trace + normal[i][i];
        }
        let mut u = *normal;
        for i in 0..COMPONENTS {
            u[i][i] = u[i][i] + self.all(REGULAR) * trace;
        }
        let mut sound = one;
        for i in 0..COMPONENTS {
            let root = u[i][i].sqrt();
            sound = zero.where_below(root, sound, zero);
            let per_root = one / root;
            for j in i..COMPONENTS {
                u[i][j] = u[i][j] * per_root;
            }
            let row = u[i];
            for k in i + 1..COMPONENTS {
                for j in k..COMPONENTS {
                    u[k][j] = u[k][j] - row[k] * row[j];
                }
            }
        }
        (u, sound)
    }

    /// Solves Uᵀ U x = b.
    #[inline(always)]
    fn solve(u: &Matrix<S>, mut b: Row<S>) -> Row<S> {
        for i in 0..COMPONENTS {
            b[i] = b[i] / u[i][i];
            for j in i + 1..COMPONENTS {
                b[j] = b[j] - b[i] * u[i][j];
            }
        }
        for i in (0..COMPONENTS).rev() {
            b[i] = b[i] / u[i][i];
            for j in 0..i {
                b[j] = b[j] - u[j][i] * b[i];
            }
        }
        b
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use pulp::{Arch, Scalar, WithSimd};

    const FLOOR: f64 = 0.1;

    struct Shares<'a>(&'a [[Vec3; 8]; CELLS]);

    impl WithSimd for Shares<'_> {
        type Output = [[f64; CELLS]; SPRINGS];

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
            shares(simd, self.0, FLOOR)
        }
    }

    fn shares_of(corners: &[Vec3; 8]) -> [f64; SPRINGS] {
        Shares(&[*corners; CELLS])
            .with_simd(Scalar::new())
            .map(|of| of[0])
    }

    /// Distance of the tensor of these shares from the isotropic one.
    fn off(corners: &[Vec3; 8], shares: &[f64; SPRINGS]) -> f64 {
        let simd = Scalar::new();
        let places = corners.map(|p| [0, 1, 2].map(|a| [p[a]; CELLS]));
        let fit = Fit::new(simd, &places, 0, 1e-9);
        let missing = fit.missing(&shares.map(|s| Wide::all(simd, s)));
        let mut square = [0.0];
        fit.dot(&missing, &missing).store(&mut square, 0);
        square[0].sqrt()
    }

    fn cube() -> [Vec3; 8] {
        std::array::from_fn(|c| Vec3::new((c & 1) as f64, (c >> 1 & 1) as f64, (c >> 2) as f64))
    }

    fn distorted(moves: &[f64]) -> [Vec3; 8] {
        let mut corners = cube();
        for (corner, way) in corners.iter_mut().zip(moves.chunks_exact(3)) {
            *corner += Vec3::new(way[0], way[1], way[2]);
        }
        corners
    }

    #[test]
    fn cube_is_isotropic_with_its_own_shares() {
        let shares = shares_of(&cube());
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
        let fitted = shares_of(&corners);
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
            let corners = distorted(&moves);
            let plain = PAIRS.map(|[a, b]| share(a, b));
            let fitted = shares_of(&corners);
            let off = |s| off(&corners, s);
            prop_assert!(off(&fitted) <= off(&plain) + 1e-9, "{} {}", off(&fitted), off(&plain));
            prop_assert!(fitted.iter().all(|s| *s > 0.0));
        }

        #[test]
        fn shares_depend_on_neither_other_cells_nor_the_width_of_vectors(
            moves in prop::collection::vec(-0.6..0.6f64, 24 * CELLS),
            cubes in prop::array::uniform8(any::<bool>()),
        ) {
            let mut cells = [cube(); CELLS];
            for (l, moves) in moves.chunks_exact(24).enumerate().filter(|c| !cubes[c.0]) {
                cells[l] = distorted(moves);
            }
            let together = Arch::new().dispatch(Shares(&cells));
            for (l, cell) in cells.iter().enumerate() {
                prop_assert_eq!(together.map(|of| of[l].to_bits()), shares_of(cell).map(f64::to_bits));
            }
        }
    }
}
