//! The directions in which a node may move.
//!
//! They come from the normals m of the faces that hold the node: directions along which the mean of m mᵀ is small are
//! free, so a node slides within a face, along a crease, and stays in a corner.

use nalgebra::{Matrix3, SymmetricEigen};

use crate::cell::{FACES, NO_CELL};
use crate::{FaceId, Topology};

/// Directions with a larger share of the normals than this are held: faces that meet at more than
/// about 53 degrees make a crease.
const HELD_SHARE: f64 = 0.2;

/// The directions left to a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Freedom {
    /// It may go anywhere.
    Free,
    /// It may go where this projector leads.
    Held(Matrix3<f64>),
    /// It belongs to bone.
    Pinned,
}

/// The directions left to a node by the surfaces it lies on, old cuts among them.
pub(crate) fn freedom(topology: &Topology, node: u32) -> Freedom {
    if topology.is_pinned(node) {
        return Freedom::Pinned;
    }
    let cells = topology.node_cells[node as usize];
    let region = |cell: &u32| topology.region(*cell);
    if topology.is_within(node) && cells.iter().all(|c| region(c) == region(&cells[0])) {
        return Freedom::Free;
    }
    let mut normals = Matrix3::zeros();
    let mut total = 0.0;
    for (slot, &cell) in cells.iter().enumerate().filter(|c| *c.1 != NO_CELL) {
        for axis in 0..3 {
            let face = FaceId::new(cell, 2 * axis + (slot >> axis & 1));
            let behind = topology.model.cells[cell as usize].neighbours[face.face()];
            let holds = match topology.across(face) {
                // At the front of an old cut the node still holds both sides together.
                NO_CELL => behind == NO_CELL || cells[slot ^ (1 << axis)] != behind,
                other => topology.region(other) != topology.region(cell),
            };
            if holds {
                let [a, b, c, d] =
                    FACES[face.face()].map(|i| topology.rest(topology.corners(cell)[i]));
                let area = (c - a).cross(&(d - b));
                let size = area.norm();
                if size > 0.0 {
                    normals += area * area.transpose() / size;
                    total += size;
                }
            }
        }
    }
    if total == 0.0 {
        return Freedom::Free;
    }
    let eigen = SymmetricEigen::new(normals / total);
    let mut free = Matrix3::zeros();
    for (value, direction) in eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
    {
        if *value < HELD_SHARE {
            free += direction * direction.transpose();
        }
    }
    Freedom::Held(free)
}
