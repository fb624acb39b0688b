//! Quality criteria that a cell must meet to carry springs.
//!
//! Two measures judge a cell: the determinant of the three edges at each of its eight corners (1 for a cube of
//! the lattice, in units of Δd³) and the length of its 28 springs. "Not inverted" here requires a positive
//! determinant at every corner, which is stricter than a positive volume.

use palpate_tissue::Vec3;

/// No corner of a built model has a smaller determinant, in Δd³.
pub const CORNER_FLOOR: f64 = 0.01;
/// No spring of a built model is shorter, in Δd.
pub const SPRING_FLOOR: f64 = 0.3;

/// Pairs of corners: every spring of a cell once.
const PAIRS: [(usize, usize); 28] = pairs();

const fn pairs() -> [(usize, usize); 28] {
    let mut pairs = [(0, 0); 28];
    let mut n = 0;
    let mut a = 0;
    while a < 8 {
        let mut b = a + 1;
        while b < 8 {
            pairs[n] = (a, b);
            n += 1;
            b += 1;
        }
        a += 1;
    }
    pairs
}

/// The determinant of the edges at corner `c`, and the product of their lengths.
fn corner(corners: &[Vec3; 8], c: usize) -> (f64, f64) {
    let edge = |axis: usize| {
        let to = corners[c ^ (1 << axis)] - corners[c];
        if c >> axis & 1 == 1 { -to } else { to }
    };
    let [x, y, z] = [edge(0), edge(1), edge(2)];
    let lengths = (x.norm_squared() * y.norm_squared() * z.norm_squared()).sqrt();
    (x.dot(&y.cross(&z)), lengths)
}

/// The least determinant at a corner, in m³.
pub(super) fn worst_corner(corners: &[Vec3; 8]) -> f64 {
    (0..8)
        .map(|c| corner(corners, c).0)
        .fold(f64::INFINITY, f64::min)
}

/// The least scaled Jacobian: the determinant at a corner over the product of its edges' lengths,
/// -1 to 1 (Knupp 2000), 1 for a box.
pub(super) fn scaled_jacobian(corners: &[Vec3; 8]) -> f64 {
    (0..8)
        .map(|c| {
            let (det, lengths) = corner(corners, c);
            if lengths > 0.0 { det / lengths } else { 0.0 }
        })
        .fold(f64::INFINITY, f64::min)
}

/// The shortest spring of a cell, in m.
pub(super) fn shortest_spring(corners: &[Vec3; 8]) -> f64 {
    PAIRS
        .iter()
        .map(|&(a, b)| (corners[a] - corners[b]).norm_squared())
        .fold(f64::INFINITY, f64::min)
        .sqrt()
}

/// Whether a cell has every determinant above `det` Δd³ and no spring below `length` Δd.
pub(super) fn passes(corners: &[Vec3; 8], spacing: f64, det: f64, length: f64) -> bool {
    let (det, length) = (det * spacing.powi(3), length * spacing);
    PAIRS
        .iter()
        .all(|&(a, b)| (corners[a] - corners[b]).norm_squared() >= length * length)
        && (0..8).all(|c| corner(corners, c).0 >= det)
}
