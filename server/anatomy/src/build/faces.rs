//! The faces between cells of different regions, and at the outside: the interfaces of the model.

use palpate_tissue::cell::{FACES, NO_CELL};
use palpate_tissue::{Cell, Vec3};
use rayon::prelude::*;

use super::interfaces::Interface;

/// Stands for the outside where a region is named.
pub(super) const OUTSIDE: u16 = u16::MAX;

/// One face, wound so that it looks out of `region`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Face {
    /// Its corners, counter-clockwise seen from outside `region`.
    pub(super) nodes: [u32; 4],
    /// The region whose interface it is: the later one of two.
    pub(super) region: u16,
    /// The region on the other side, or [`OUTSIDE`].
    pub(super) other: u16,
}

impl Face {
    pub(super) fn interface(&self) -> Interface {
        if self.other == OUTSIDE {
            Interface::Outer
        } else {
            Interface::Of(self.region.into())
        }
    }

    pub(super) fn corners(&self, positions: &[Vec3]) -> [Vec3; 4] {
        self.nodes.map(|n| positions[n as usize])
    }

    /// Its two triangles, split along the shorter diagonal as the outer surface of a model is.
    pub(super) fn triangles(&self, positions: &[Vec3]) -> [[u32; 3]; 2] {
        let [a, b, c, d] = self.nodes;
        let [p, q, r, s] = self.corners(positions);
        if (r - p).norm_squared() <= (s - q).norm_squared() {
            [[a, b, c], [a, c, d]]
        } else {
            [[a, b, d], [b, c, d]]
        }
    }

    /// Its middle, and its area in m².
    pub(super) fn middle_and_area(&self, positions: &[Vec3]) -> (Vec3, f64) {
        let [a, b, c, d] = self.corners(positions);
        let [p, q] = [(b, c), (c, d)].map(|(p, q)| (p - a).cross(&(q - a)).norm());
        let area = f64::midpoint(p, q);
        ((a + b + c + d) / 4.0, area)
    }

    /// A third of the flux of the position vector about `origin` through the bilinear face: summed
    /// over a closed surface this is its volume, as [`palpate_tissue::cell::cell_volume`] measures it.
    pub(super) fn flux(&self, positions: &[Vec3], origin: &Vec3) -> f64 {
        let [a, b, c, d] = self.corners(positions).map(|p| p - origin);
        let (ab, cd) = (a.cross(&b), c.cross(&d));
        (ab.dot(&(c + d)) + cd.dot(&(a + b))) / 12.0
    }
}

/// All faces of the interfaces, in the order of cells.
pub(super) fn faces(cells: &[Cell]) -> Vec<Face> {
    cells
        .par_iter()
        .flat_map_iter(|cell| {
            (0..6).filter_map(move |face| {
                let across = cell.neighbours[face];
                let other = if across == NO_CELL {
                    OUTSIDE
                } else {
                    cells[across as usize].region.0
                };
                // Between two regions the later one has the face.
                (other == OUTSIDE || other < cell.region.0).then(|| Face {
                    nodes: FACES[face].map(|c| cell.corners[c]),
                    region: cell.region.0,
                    other,
                })
            })
        })
        .collect()
}

/// Volumes of all regions in m³, from their faces.
pub(super) fn volumes(faces: &[Face], positions: &[Vec3], regions: usize) -> Vec<f64> {
    let origin = positions.first().copied().unwrap_or_default();
    let mut volumes = vec![0.0; regions];
    for face in faces {
        let flux = face.flux(positions, &origin);
        volumes[face.region as usize] += flux;
        if face.other != OUTSIDE {
            volumes[face.other as usize] -= flux;
        }
    }
    volumes
}
