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
    /// Of an opened face, the corners of the other side, in the same order.
    beyond: Option<[u32; 4]>,
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

    /// Its two triangles, split along the shorter diagonal as the outer surface of a model is; along the other one where
    /// the two sides of an opened face would share it.
    pub(super) fn triangles(&self, positions: &[Vec3]) -> [[u32; 3]; 2] {
        let [a, b, c, d] = self.nodes;
        let first = has_short_first(self.nodes, positions);
        let shared = self.beyond.is_some_and(|beyond| {
            let ends = if first { [0, 2] } else { [1, 3] };
            ends.iter().all(|i| beyond[*i] == self.nodes[*i])
                && has_short_first(beyond, positions) == first
        });
        if first == shared {
            [[a, b, d], [b, c, d]]
        } else {
            [[a, b, c], [a, c, d]]
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

/// Whether the diagonal from the first corner is the shorter one.
fn has_short_first(nodes: [u32; 4], positions: &[Vec3]) -> bool {
    let [p, q, r, s] = nodes.map(|n| positions[n as usize]);
    (r - p).norm_squared() <= (s - q).norm_squared()
}

/// All faces of the interfaces, in the order of cells. `lattice` has the lattice point of each node.
pub(super) fn faces(cells: &[Cell], lattice: &[[i32; 3]]) -> Vec<Face> {
    let opened = opened(cells, lattice);
    let beyond = |index: usize, face: usize| {
        let found = opened.binary_search_by_key(&[index, face], |(side, _)| *side);
        let far = cells[opened[found.ok()?].1].corners;
        Some(FACES[face].map(|c| far[c ^ (1 << (face / 2))]))
    };
    let beyond = &beyond;
    cells
        .par_iter()
        .enumerate()
        .flat_map_iter(|(index, cell)| {
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
                    beyond: beyond(index, face),
                })
            })
        })
        .collect()
}

/// Sides of opened faces as a cell and its face, sorted, each with the cell on the other side. They are two outer faces in
/// one place of the lattice.
fn opened(cells: &[Cell], lattice: &[[i32; 3]]) -> Vec<([usize; 2], usize)> {
    let outer = cells.iter().enumerate().flat_map(|(index, cell)| {
        let faces = (0..6).filter(|face| cell.neighbours[*face] == NO_CELL);
        faces.map(move |face| {
            let mut place = lattice[cell.corners[0] as usize];
            place[face / 2] += (face % 2) as i32;
            ((place, face / 2), [index, face])
        })
    });
    let mut outer: Vec<_> = outer.collect();
    outer.par_sort_unstable();
    let pairs = outer.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() == 2);
    let sides = pairs.flat_map(|pair| {
        let [a, b] = [pair[0].1, pair[1].1];
        [(a, b[0]), (b, a[0])]
    });
    let mut sides: Vec<([usize; 2], usize)> = sides.collect();
    sides.sort_unstable();
    sides
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
