//! Quality criteria that a cell must meet to carry springs.
//!
//! Two measures judge a cell: the determinant of the three edges at each of its eight corners (1 for a cube of
//! the lattice, in units of Δd³) and the length of its 28 springs. "Not inverted" here requires a positive
//! determinant at every corner, which is stricter than a positive volume.

use palpate_tissue::Vec3;
use palpate_tissue::cell::PAIRS;

/// No corner of a built model has a smaller determinant, in Δd³.
pub const CORNER_FLOOR: f64 = 0.01;
/// No spring of a built model is shorter, in Δd.
pub const SPRING_FLOOR: f64 = 0.3;

/// The determinant of the edges at corner `c`.
pub(super) fn corner(corners: &[Vec3; 8], c: usize) -> f64 {
    let [x, y, z] = [1, 2, 4].map(|step| corners[c | step] - corners[c & !step]);
    x.dot(&y.cross(&z))
}

/// The least determinant at a corner, in m³.
pub(super) fn worst_corner(corners: &[Vec3; 8]) -> f64 {
    (0..8)
        .map(|c| corner(corners, c))
        .fold(f64::INFINITY, f64::min)
}

/// The shortest spring of a cell, in m.
pub(super) fn shortest_spring(corners: &[Vec3; 8]) -> f64 {
    PAIRS
        .iter()
        .map(|&[a, b]| (corners[a] - corners[b]).norm_squared())
        .fold(f64::INFINITY, f64::min)
        .sqrt()
}

/// Whether a cell has every determinant above `det` Δd³ and no spring below `length` Δd.
pub(super) fn passes(corners: &[Vec3; 8], spacing: f64, det: f64, length: f64) -> bool {
    let (det, length) = (det * spacing.powi(3), length * spacing);
    PAIRS
        .iter()
        .all(|&[a, b]| (corners[a] - corners[b]).norm_squared() >= length * length)
        && (0..8).all(|c| corner(corners, c) >= det)
}
