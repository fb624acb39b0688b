//! The hexahedral cell: numbering of its corners, edges, faces and diagonals, and its volume.
//!
//! Corner `c` of a cell stands at lattice offset `(c & 1, c >> 1 & 1, c >> 2 & 1)`. Face `2 a` looks
//! against axis `a`, face `2 a + 1` along it.

use crate::{RegionId, Vec3};

/// Marks the absence of a cell (a face on the outside, an empty corner slot of a node).
pub const NO_CELL: u32 = u32::MAX;

/// Corners of each face, counter-clockwise seen from outside the cell.
pub const FACES: [[usize; 4]; 6] = [
    [0, 4, 6, 2],
    [1, 3, 7, 5],
    [0, 1, 5, 4],
    [2, 6, 7, 3],
    [0, 2, 3, 1],
    [4, 5, 7, 6],
];

/// The twelve edges of a cell, as pairs of corners: its structural springs (Lin 2007, fig. 3.2).
pub const EDGES: [[usize; 2]; 12] = [
    [0, 1],
    [2, 3],
    [4, 5],
    [6, 7],
    [0, 2],
    [1, 3],
    [4, 6],
    [5, 7],
    [0, 4],
    [1, 5],
    [2, 6],
    [3, 7],
];

/// All pairs of corners of a cell: each of its springs once.
pub const PAIRS: [[usize; 2]; 28] = {
    let mut list = [[0; 2]; 28];
    let (mut a, mut n) = (0, 0);
    while a < 8 {
        let mut b = a + 1;
        while b < 8 {
            list[n] = [a, b];
            n += 1;
            b += 1;
        }
        a += 1;
    }
    list
};

/// One hexahedron of the lattice. Cuts rewire its corners; they never remove it or add another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cell {
    /// Node at each corner.
    pub corners: [u32; 8],
    /// Cell behind each face, or [`NO_CELL`].
    pub neighbours: [u32; 6],
    /// The region, and through it the material, that fills the cell.
    pub region: RegionId,
}

/// Volume in m³ of the trilinear hexahedron with these corners; negative when it is inside out.
///
/// By the divergence theorem over its six faces. The flux through a bilinear face is the mean of
/// the fluxes through its two triangulations, so neighbours agree about the face between them and
/// volumes add up exactly.
pub fn cell_volume(corners: &[Vec3; 8]) -> f64 {
    let origin = corners[0];
    let mut six_volumes_twice = 0.0;
    for face in FACES {
        let [a, b, c, d] = face.map(|i| corners[i] - origin);
        let ab = a.cross(&b);
        let cd = c.cross(&d);
        six_volumes_twice += ab.dot(&(c + d)) + cd.dot(&(a + b));
    }
    six_volumes_twice / 12.0
}

/// Scaled Jacobian of the hexahedron with these corners (Knupp 2000): the least, over the corners,
/// of the determinant of the three edges that leave it over the product of their lengths. 1 for a
/// box, 0 where a corner is flat, negative where one is inside out.
pub fn scaled_jacobian(corners: &[Vec3; 8]) -> f64 {
    (0..8)
        .map(|c| {
            // Each edge runs from low to high along its axis, so that the sign is that of the volume.
            let [x, y, z] = [1, 2, 4].map(|step| corners[c | step] - corners[c & !step]);
            let lengths = (x.norm_squared() * y.norm_squared() * z.norm_squared()).sqrt();
            if lengths > 0.0 {
                x.dot(&y.cross(&z)) / lengths
            } else {
                0.0
            }
        })
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(side: f64) -> [Vec3; 8] {
        std::array::from_fn(|c| {
            Vec3::new((c & 1) as f64, (c >> 1 & 1) as f64, (c >> 2 & 1) as f64) * side
        })
    }

    #[test]
    fn volume_of_a_cube_and_of_its_linear_images_is_exact() {
        let unit = cube(2.0);
        assert!((cell_volume(&unit) - 8.0).abs() < 1e-12);
        let map = nalgebra::Matrix3::new(1.0, 0.3, 0.0, -0.2, 2.0, 0.1, 0.0, 0.5, 0.7);
        let sheared = unit.map(|p| map * p + Vec3::new(5.0, -3.0, 1.0));
        assert!((cell_volume(&sheared) - 8.0 * map.determinant()).abs() < 1e-10);
    }

    #[test]
    fn scaled_jacobian_is_one_for_a_box_and_negative_if_inverted() {
        let mut corners = cube(2.0).map(|p| p.component_mul(&Vec3::new(1.0, 3.0, 0.5)));
        assert!((scaled_jacobian(&corners) - 1.0).abs() < 1e-12);
        corners[7] = Vec3::new(1.0, 3.0, 0.1);
        let pushed_in = scaled_jacobian(&corners);
        assert!(pushed_in < 1.0);
        corners[7] = Vec3::new(-1.0, -1.0, -1.0);
        assert!(scaled_jacobian(&corners) < 0.0);
        corners[7] = corners[6];
        assert!(scaled_jacobian(&corners) <= 0.0, "an edge of no length");
    }

    #[test]
    fn edges_and_faces_are_those_of_the_cube() {
        for [a, b] in EDGES {
            assert_eq!((a ^ b).count_ones(), 1);
        }
        for (axis, faces) in FACES.chunks(2).enumerate() {
            assert!(faces[0].iter().all(|c| c >> axis & 1 == 0));
            assert!(faces[1].iter().all(|c| c >> axis & 1 == 1));
        }
    }
}
