//! Storage and products of the matrices of coarse elements.

use std::sync::Arc;

use pulp::Simd;

use super::lanes::V;
use super::quad::{Quad, ZERO};

/// Unknowns of an element: corner `c` along axis `a` is [`at`]`(c, a)`.
pub(crate) const SIZE: usize = 24;
/// Number of corner `c` along axis `a` among the unknowns.
#[inline(always)]
pub(crate) const fn at(c: usize, a: usize) -> usize {
    3 * c + a
}
/// Rows of a stored matrix: four per corner, the last of them zero. A product then reads and writes point values in
/// their memory layout, two vectors of sixteen in all.
pub(crate) const ROWS: usize = 32;
/// Stored row of corner `c` along axis `a`.
#[inline(always)]
pub(crate) const fn lane(c: usize, a: usize) -> usize {
    4 * c + a
}

/// A matrix column by column; symmetric.
#[derive(Clone)]
#[repr(align(64))]
pub(crate) struct Columns(pub(crate) [[f32; ROWS]; SIZE]);

impl Columns {
    pub(crate) const ZERO: Self = Self([[0.0; ROWS]; SIZE]);

    pub(crate) fn new(k: &[[f64; SIZE]; SIZE]) -> Self {
        let mut columns = Self::ZERO;
        for (column, from) in columns.0.iter_mut().zip(k) {
            for c in 0..8 {
                for a in 0..3 {
                    column[lane(c, a)] = from[at(c, a)] as f32;
                }
            }
        }
        columns
    }

    /// `K x`, row by row; x are the values of these points.
    #[inline(always)]
    pub(crate) fn multiply<S: Simd>(&self, simd: S, points: &[u32; 8], of: &[Quad]) -> Rows {
        product(simd, &self.0, 1.0, points, of)
    }
}

/// The numbers of a column, in either format.
trait Column {
    fn load<S: Simd>(&self, simd: S, at: usize) -> V<S>;
}

impl Column for [f32; ROWS] {
    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, at: usize) -> V<S> {
        V::load(simd, self, at)
    }
}

impl Column for [i16; ROWS] {
    #[inline(always)]
    fn load<S: Simd>(&self, simd: S, at: usize) -> V<S> {
        V::load_short(simd, self, at)
    }
}

/// `scale` times a matrix times the values of these points.
#[inline(always)]
fn product<S: Simd>(
    simd: S,
    columns: &[impl Column; SIZE],
    scale: f32,
    points: &[u32; 8],
    of: &[Quad],
) -> Rows {
    let mut y = Rows([0.0; ROWS]);
    let mut from = 0;
    while from < ROWS {
        // One chain of sums per axis; a single chain would wait for each addition.
        let zero = V::all(simd, 0.0);
        let (mut sum_x, mut sum_y, mut sum_z) = (zero, zero, zero);
        for c in 0..8 {
            let x = &of[points[c] as usize];
            let k = &columns[3 * c..3 * c + 3];
            sum_x = sum_x + k[0].load(simd, from) * V::all(simd, x[0]);
            sum_y = sum_y + k[1].load(simd, from) * V::all(simd, x[1]);
            sum_z = sum_z + k[2].load(simd, from) * V::all(simd, x[2]);
        }
        let sum = V::all(simd, scale) * (sum_x + sum_y + sum_z);
        sum.store(&mut y.0, from);
        from += V::<S>::WIDTH;
    }
    y
}

/// Forces of a product: four per corner, the last of them zero.
#[repr(align(64))]
pub(crate) struct Rows([f32; ROWS]);

impl Rows {
    #[inline(always)]
    pub(crate) fn corner(&self, c: usize) -> Quad {
        let r = &self.0[4 * c..4 * c + 4];
        [r[0], r[1], r[2], r[3]]
    }

    #[inline(always)]
    pub(crate) fn corners(&self) -> Corners {
        let mut list = [ZERO; 8];
        for (c, to) in list.iter_mut().enumerate() {
            *to = self.corner(c);
        }
        list
    }
}

/// A matrix of 16-bit integers times a scale.
///
/// The active set around a tool has some seven hundred elements with almost as many different matrices. In single
/// precision they exceed a cache of 2 MB; with half of the bytes a quick step takes 5 % less. Coarse corrections need
/// few digits, but rigid translations must make no additional force: each diagonal block compensates the rounding
/// errors of its rows.
#[derive(Clone)]
#[repr(align(64))]
pub(crate) struct Short {
    columns: [[i16; ROWS]; SIZE],
    scale: f32,
}

/// Largest integer of a matrix, with room for the rounding compensation.
const LARGEST: f64 = 32_700.0;
/// Entries below this part of the largest one count as zero when blocks are summed.
const NOTHING: f64 = 1e-5;
/// Largest ratio of corner stiffnesses that the 16-bit format represents.
const CONTRAST: f64 = 64.0;

impl Short {
    /// The nearest 16-bit matrix; `None` if its corners are too different.
    #[inline(always)]
    pub(crate) fn new(k: &[[f64; SIZE]; SIZE]) -> Option<Self> {
        let diagonal = || (0..SIZE).map(|i| k[i][i]).filter(|&v| v != 0.0);
        let largest = diagonal().fold(0.0, f64::max);
        let least = diagonal().fold(f64::MAX, f64::min);
        if largest <= 0.0 || largest > CONTRAST * least {
            return None;
        }
        let scale = largest / LARGEST;
        let per_scale = 1.0 / scale;
        let mut rounded = [[0i16; SIZE]; SIZE];
        for (to, from) in rounded.as_flattened_mut().iter_mut().zip(k.as_flattened()) {
            *to = (from * per_scale).round() as i16;
        }
        let mut columns = [[0i16; ROWS]; SIZE];
        for (column, from) in columns.iter_mut().zip(&rounded) {
            for c in 0..8 {
                for a in 0..3 {
                    column[lane(c, a)] = from[at(c, a)];
                }
            }
        }
        for b in 0..3 {
            // Sums of all blocks of a row.
            let (mut whole, mut row) = ([0.0; SIZE], [0i32; SIZE]);
            for q in 0..8 {
                for i in 0..SIZE {
                    whole[i] += k[at(q, b)][i];
                    row[i] += i32::from(rounded[at(q, b)][i]);
                }
            }
            for (c, a) in (0..SIZE).map(|i| (i / 3, i % 3)) {
                if whole[at(c, a)].abs() <= NOTHING * largest {
                    // A rounding or two per block: see LARGEST.
                    columns[at(c, b)][lane(c, a)] -= row[at(c, a)] as i16;
                }
            }
        }
        let scale = scale as f32;
        Some(Self { columns, scale })
    }

    /// `K x`, row by row; x are the values of these points.
    #[inline(always)]
    fn multiply<S: Simd>(&self, simd: S, points: &[u32; 8], of: &[Quad]) -> Rows {
        product(simd, &self.columns, self.scale, points, of)
    }
}

/// Numbers of a matrix with those that its element derives from them.
pub(crate) struct Bounded<K> {
    k: K,
    bound: Bound,
    even: bool,
}

/// Diagonal blocks of the corners times the largest eigenvalue of the block-scaled element: their sum over elements bounds the
/// whole matrix from above.
pub(crate) type Bound = [[f32; 6]; 8];

/// Largest piece of memory that glibc keeps for the thread that frees it. The next data of that thread may lie there, so that
/// the memory of the thread that allocated the piece is never returned.
const KEPT_BY_THREAD: usize = 1032;

const _: () = assert!(size_of::<Bounded<Short>>() > KEPT_BY_THREAD);

/// The matrix of an element; copies share it. It is one piece of memory: worker threads allocate matrices and the thread that
/// drops a cut frees them (see [`KEPT_BY_THREAD`]).
#[derive(Clone)]
pub(crate) enum Matrix {
    Full(Arc<Bounded<Columns>>),
    Short(Arc<Bounded<Short>>),
}

impl Matrix {
    /// The matrix of a homogeneous element stays in f32.
    #[inline(always)]
    pub(crate) fn new(k: &[[f64; SIZE]; SIZE], bound: Bound, even: bool) -> Self {
        match (!even).then(|| Short::new(k)).flatten() {
            Some(k) => Self::Short(Arc::new(Bounded { k, bound, even })),
            None => Self::Full(Arc::new(Bounded {
                k: Columns::new(k),
                bound,
                even,
            })),
        }
    }

    /// See [`Bound`].
    pub(crate) fn bound(&self) -> &Bound {
        match self {
            Self::Full(m) => &m.bound,
            Self::Short(m) => &m.bound,
        }
    }

    /// Whether the element is homogeneous: cubes of one tissue.
    pub(crate) fn even(&self) -> bool {
        match self {
            Self::Full(m) => m.even,
            Self::Short(m) => m.even,
        }
    }

    /// Entry in a column and a stored row.
    pub(crate) fn get(&self, column: usize, row: usize) -> f32 {
        match self {
            Self::Full(m) => m.k.0[column][row],
            Self::Short(m) => m.k.scale * f32::from(m.k.columns[column][row]),
        }
    }

    /// The matrix in double precision.
    #[inline(always)]
    pub(crate) fn dense(&self) -> [[f64; SIZE]; SIZE] {
        let mut dense = [[0.0; SIZE]; SIZE];
        for (j, to) in dense.iter_mut().enumerate() {
            let column = match self {
                Self::Full(m) => m.k.0[j],
                Self::Short(m) => m.k.columns[j].map(|v| m.k.scale * f32::from(v)),
            };
            for c in 0..8 {
                for a in 0..3 {
                    to[at(c, a)] = column[lane(c, a)].into();
                }
            }
        }
        dense
    }

    /// Adds this matrix to another.
    pub(crate) fn add_to(&self, to: &mut Columns) {
        let to = to.0.as_flattened_mut().iter_mut();
        match self {
            Self::Full(m) => to.zip(m.k.0.as_flattened()).for_each(|(to, v)| *to += v),
            Self::Short(m) => to
                .zip(m.k.columns.as_flattened())
                .for_each(|(to, v)| *to += m.k.scale * f32::from(*v)),
        }
    }

    /// `K x`, row by row; x are the values of these points.
    #[inline(always)]
    pub(crate) fn multiply<S: Simd>(&self, simd: S, points: &[u32; 8], of: &[Quad]) -> Rows {
        match self {
            Self::Full(m) => m.k.multiply(simd, points, of),
            Self::Short(m) => m.k.multiply(simd, points, of),
        }
    }
}

/// Displacements or forces of the corners of one element.
pub(crate) type Corners = [Quad; 8];

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Matrix of springs between all pairs of corners, each along some direction.
    fn springs(numbers: &[f64]) -> [[f64; SIZE]; SIZE] {
        let mut k = [[0.0; SIZE]; SIZE];
        let mut numbers = numbers.chunks_exact(4).cycle();
        for p in 0..8 {
            for q in 0..p {
                let s = numbers.next().unwrap();
                for (a, b) in (0..9).map(|i| (i / 3, i % 3)) {
                    let v = s[3] * s[a] * s[b];
                    for (i, j, sign) in [(p, p, 1.0), (q, q, 1.0), (p, q, -1.0), (q, p, -1.0)] {
                        k[at(i, a)][at(j, b)] += sign * v;
                    }
                }
            }
        }
        k
    }

    fn product(short: &Short, x: &Corners) -> Corners {
        let points = [0, 1, 2, 3, 4, 5, 6, 7];
        short.multiply(pulp::Scalar::new(), &points, x).corners()
    }

    proptest! {
        #[test]
        fn sixteen_bit_matrix_keeps_forces_and_translations(
            numbers in prop::collection::vec(0.3..1.0f64, 4 * 28),
            x in prop::collection::vec(-1.0..1.0f32, SIZE),
            whole in prop::array::uniform3(-8.0..8.0f32),
        ) {
            let k = springs(&numbers);
            let short = Short::new(&k).unwrap();
            let mut at_corners = [ZERO; 8];
            let mut together = [ZERO; 8];
            for c in 0..8 {
                for a in 0..3 {
                    at_corners[c][a] = x[at(c, a)];
                    // Small integers, whose sums are exact.
                    together[c][a] = whole[a].round();
                }
            }
            let y = product(&short, &at_corners);
            let stiffest = (0..SIZE).map(|i| k[i][i]).fold(0.0, f64::max);
            for c in 0..8 {
                for a in 0..3 {
                    let exact: f64 = (0..SIZE).map(|j| k[j][at(c, a)] * f64::from(x[j])).sum();
                    prop_assert!((f64::from(y[c][a]) - exact).abs() < 1e-3 * stiffest);
                }
            }
            for f in product(&short, &together) {
                prop_assert_eq!(f, ZERO);
            }
        }
    }

    #[test]
    fn matrix_of_high_contrast_stays_in_f32() {
        let mut k = springs(&[0.5; 4]);
        for i in 0..SIZE {
            for j in 0..SIZE {
                for side in [i, j] {
                    k[i][j] *= if side < 3 { 0.05 } else { 1.0 };
                }
            }
        }
        assert!(Short::new(&k).is_none());
    }
}
