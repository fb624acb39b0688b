//! Parting a topology along a sheet: nodes are doubled, faces opened, and what follows from them is
//! brought up to date around them (Lin 2007, figs 5.7 to 5.9; reconstructed).

use std::collections::BTreeSet;

use super::cell_fans::{Fans, NO_FAN, Opening};
use super::sheet::{is_bone, nodes_of};
use crate::cell::{FACES, NO_CELL, cell_volume};
use crate::{FaceId, Topology};

/// The fans of each node of a sheet once its faces are open.
pub(crate) fn fans(topology: &Topology, sheet: &[FaceId], nodes: &[u32]) -> Vec<Fans> {
    let opening = Opening::new(topology, sheet);
    nodes.iter().map(|&n| opening.fans(n)).collect()
}

/// Whether a node is doubled, given its fans.
pub(crate) fn is_parted(fans: Fans) -> bool {
    let mut fans = fans.into_iter().filter(|&f| f != NO_FAN);
    let first = fans.next();
    fans.any(|f| Some(f) != first)
}

/// Gives every fan of every node of the sheet a node of its own: the first fan, or the first one with a cell of bone, keeps
/// the old one, so that no node ceases to be pinned; the others get new ones at the end. Returns pairs of new node and the
/// node it was doubled from.
pub(crate) fn double(topology: &mut Topology, nodes: &[u32], fans: &[Fans]) -> Vec<(u32, u32)> {
    let mut doubled = Vec::new();
    for (&node, fans) in nodes.iter().zip(fans) {
        let cells = topology.node_cells[node as usize];
        let has_bone = |slot: &usize| fans[*slot] != NO_FAN && is_bone(topology, cells[*slot]);
        let mut labels: BTreeSet<u8> = fans.iter().copied().filter(|&f| f != NO_FAN).collect();
        let bone = (0..8).filter(has_bone).map(|slot| fans[slot]).min();
        if let Some(keeps) = bone.or_else(|| labels.first().copied()) {
            labels.remove(&keeps);
        }
        for label in labels {
            let new = topology.rest.len() as u32;
            doubled.push((new, node));
            let mut cells = [NO_CELL; 8];
            for slot in (0..8).filter(|&s| fans[s] == label) {
                let cell = topology.node_cells[node as usize][slot];
                cells[slot] = cell;
                topology.node_cells[node as usize][slot] = NO_CELL;
                topology.corners[cell as usize][slot] = new;
            }
            topology.node_cells.push(cells);
            topology.rest.push(topology.rest(node));
            topology.mass.push(0.0);
            topology.pinned.push(false);
        }
    }
    doubled
}

/// Opens the faces of the sheet and adds both sides of each to the boundary; triangles of faces that
/// were exposed before follow the doubled nodes.
pub(crate) fn open(topology: &mut Topology, sheet: &[FaceId], doubled: &[(u32, u32)]) {
    for &(node, _) in doubled {
        let cells = topology.node_cells[node as usize];
        for (slot, &cell) in cells.iter().enumerate().filter(|c| *c.1 != NO_CELL) {
            for axis in 0..3 {
                let face = FaceId::new(cell, 2 * axis + (slot >> axis & 1));
                if let Some(position) = topology.boundary_position(face) {
                    let [first, second] = topology.exposed.triangles[position];
                    let triangles = topology.split(face, first[0] == second[0]);
                    topology.exposed_mut().triangles[position] = triangles;
                }
            }
        }
    }
    for &face in sheet {
        let behind = topology.behind(face);
        let along = topology.parted_diagonal(face);
        for (side, along) in [(face, along), (behind, topology.mirrored(face, along))] {
            topology.cut[side.cell() as usize] |= 1 << side.face();
            let position = topology.exposed.faces.len() as u32;
            let triangles = topology.split(side, along);
            topology.exposed_mut().faces.push(side);
            topology.exposed_mut().triangles.push(triangles);
            topology.cut_index.open(side, position);
        }
    }
}

/// Cells and nodes around changed nodes.
pub(crate) struct Around {
    /// Cells with a changed corner, sorted.
    pub(crate) cells: Vec<u32>,
    /// All nodes whose rest position, springs or mass may have changed, sorted.
    pub(crate) nodes: Vec<u32>,
}

/// Updates volumes, masses and pins around nodes that moved or were doubled.
pub(crate) fn derive_around(topology: &mut Topology, changed: &BTreeSet<u32>) -> Around {
    let around = changed.iter().flat_map(|&node| topology.cells_around(node));
    let mut cells: Vec<u32> = around.filter(|&cell| cell != NO_CELL).collect();
    cells.sort_unstable();
    cells.dedup();
    let mut nodes: Vec<u32> = changed.iter().copied().collect();
    for &cell in &cells {
        let corners = topology.corners(cell);
        topology.cell_volume[cell as usize] = cell_volume(&corners.map(|n| topology.rest(n)));
        nodes.extend(corners);
    }
    nodes.sort_unstable();
    nodes.dedup();
    for &node in changed {
        topology.derive_node(node);
    }
    Around { cells, nodes }
}

impl Topology {
    /// The two triangles of a face: along its first diagonal (from its first corner), or its second.
    pub(crate) fn split(&self, face: FaceId, along_first: bool) -> [[u32; 3]; 2] {
        let [a, b, c, d] = nodes_of(self, face);
        if along_first {
            [[a, b, c], [a, c, d]]
        } else {
            [[a, b, d], [b, c, d]]
        }
    }

    /// Whether to split a face that is being opened along its first diagonal: the shorter of those
    /// with an end that was doubled between the two sides, so that the sides share no diagonal.
    fn parted_diagonal(&self, face: FaceId) -> bool {
        let corners = FACES[face.face()];
        let across = 1 << (face.face() / 2);
        let [near, far] = [(face.cell(), 0), (self.behind(face).cell(), across)]
            .map(|(cell, flip)| corners.map(|c| self.corners(cell)[c ^ flip]));
        let parted = |i: usize| near[i] != far[i];
        let length = |i: usize| (self.rest(near[i + 2]) - self.rest(near[i])).norm_squared();
        match (parted(0) || parted(2), parted(1) || parted(3)) {
            (true, false) => true,
            (false, true) => false,
            _ => length(0) <= length(1),
        }
    }

    /// The choice for the other side of a face that gives the same diagonal.
    fn mirrored(&self, face: FaceId, along_first: bool) -> bool {
        let across = 1 << (face.face() / 2);
        let behind = FACES[self.behind(face).face()];
        let start = FACES[face.face()][usize::from(!along_first)] ^ across;
        behind[0] == start || behind[2] == start
    }
}
