//! Lattice coordinates of every node, those doubled by cuts included.

use crate::{NO_CELL, Topology};

/// Lattice coordinates of a node: its own in the model, or for a doubled node those of the corner
/// it took over, read from a cell around it.
pub(crate) fn coordinates(topology: &Topology, node: u32) -> [i32; 3] {
    let model = topology.model();
    if let Some(own) = model.lattice.get(node as usize) {
        return *own;
    }
    for (corner, cell) in topology.cells_around(node).into_iter().enumerate() {
        if cell != NO_CELL {
            let original = model.cells[cell as usize].corners[corner];
            return model.lattice[original as usize];
        }
    }
    [0; 3]
}
