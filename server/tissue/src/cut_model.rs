//! A cut topology as a model of its own, to be stored and hosted.
//!
//! The cells keep their number, lattice place and region. Doubled nodes become nodes of the model, opened faces become
//! faces of its outer surface, and the rest positions after the cuts become its positions. So every reader of a model
//! file reads a cut model, also after a change of the cutting algorithm, which a log of strokes would not survive.
//!
//! The model has no cuts to take back. Its masses follow from its volumes, so the total mass differs by the
//! volume change of the cuts.

use crate::cell::NO_CELL;
use crate::{Boundary, Cell, FaceId, Model, Topology};

impl Topology {
    /// The topology as an uncut model with the same nodes, cells and outer surface.
    pub fn to_model(&self) -> Model {
        let built = self.model();
        let lattice = (0..self.node_count() as u32).map(|node| {
            let cells = self.cells_around(node);
            // Every node is a corner of a cell.
            let slot = cells.iter().position(|&c| c != NO_CELL).unwrap_or(0);
            built.lattice[built.cells[cells[slot] as usize].corners[slot] as usize]
        });
        let cells = (0..self.cell_count() as u32).map(|cell| Cell {
            corners: self.corners(cell),
            neighbours: std::array::from_fn(|face| self.across(FaceId::new(cell, face))),
            region: self.region(cell),
        });
        Model {
            spacing_m: built.spacing_m,
            gravity: built.gravity,
            regions: built.regions.clone(),
            nodes: (0..self.node_count() as u32)
                .map(|n| self.rest(n))
                .collect(),
            lattice: lattice.collect(),
            cells: cells.collect(),
        }
    }
}

/// Exchanges diagonals that two faces share, because an edge of the surface belongs to two triangles. Faces on both
/// sides of a wound share a diagonal if their nodes at its ends were not doubled; those of the other one were.
pub(crate) fn part_diagonals(boundary: &mut Boundary) {
    let diagonal = |t: &[[u32; 3]]| {
        let [a, b, c] = t[0];
        let [from, to] = if a == t[1][0] { [a, c] } else { [b, c] };
        [from.min(to), from.max(to)]
    };
    let pairs = boundary.triangles.chunks_exact(2).map(diagonal);
    let mut shared: Vec<([u32; 2], usize)> = pairs.zip(0..).collect();
    shared.sort_unstable();
    for group in shared.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() > 1) {
        for &(_, face) in group {
            let pair = &mut boundary.triangles[2 * face..2 * face + 2];
            let [first, second] = [pair[0], pair[1]];
            let exchanged = if first[0] == second[0] {
                let [a, b, c, d] = [first[0], first[1], first[2], second[2]];
                [[a, b, d], [b, c, d]]
            } else {
                let [a, b, c, d] = [first[0], first[1], second[1], first[2]];
                [[a, b, c], [a, c, d]]
            };
            pair.copy_from_slice(&exchanged);
        }
    }
}
