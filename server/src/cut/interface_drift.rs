//! Distances of interface nodes from the interfaces as built.

use std::collections::HashMap;

use palpate_tissue::cell::{FACES, NO_CELL};
use palpate_tissue::{FaceId, RegionId, Topology, Vec3};

use super::triangle_grid::TriangleGrid;

/// Farthest that drift is searched, in spacings; cuts move no node farther.
const REACH: f64 = 2.0;

/// An interface: two regions, or one and the outside.
type Interface = (RegionId, Option<RegionId>);

/// Largest distance in m of an interface node of a cut topology from that interface in the uncut one. The outer surface is
/// one of the interfaces.
pub(super) fn interface_drift_m(uncut: &Topology, cut: &Topology) -> f64 {
    let spacing = uncut.model().spacing_m;
    let mut grids: HashMap<Interface, TriangleGrid> = HashMap::new();
    let mut farthest: f64 = 0.0;
    for node in 0..cut.node_count() as u32 {
        let original = original(cut, node);
        let at = cut.rest(node);
        if at == uncut.rest(original) {
            continue;
        }
        for interface in interfaces_at(uncut, original) {
            let grid = grids
                .entry(interface)
                .or_insert_with(|| TriangleGrid::new(triangles(uncut, interface), spacing));
            let reach = REACH * spacing;
            let distance = grid.nearest(&at, reach).map_or(reach, |n| n.distance_m);
            farthest = farthest.max(distance);
        }
    }
    farthest
}

/// The node of the uncut model that a node is, or was doubled from.
fn original(cut: &Topology, node: u32) -> u32 {
    let cells = cut.cells_around(node);
    // Every node is a corner of a cell.
    let slot = cells.iter().position(|&c| c != NO_CELL).unwrap_or(0);
    cut.model().cells[cells[slot] as usize].corners[slot]
}

fn interface_of(uncut: &Topology, face: FaceId) -> Option<Interface> {
    let region = uncut.region(face.cell());
    match uncut.across(face) {
        NO_CELL => Some((region, None)),
        other => {
            let other = uncut.region(other);
            (other != region).then_some((region.min(other), Some(region.max(other))))
        }
    }
}

fn interfaces_at(uncut: &Topology, node: u32) -> Vec<Interface> {
    let mut found = Vec::new();
    let cells = uncut.cells_around(node);
    for (slot, &cell) in cells.iter().enumerate().filter(|c| *c.1 != NO_CELL) {
        for axis in 0..3 {
            let face = FaceId::new(cell, 2 * axis + (slot >> axis & 1));
            found.extend(interface_of(uncut, face));
        }
    }
    found.sort_unstable();
    found.dedup();
    found
}

/// The faces of an interface, each halved along both diagonals, because a face is not flat.
fn triangles(uncut: &Topology, interface: Interface) -> Vec<[Vec3; 3]> {
    let faces = (0..uncut.cell_count() as u32).flat_map(|c| (0..6).map(move |f| FaceId::new(c, f)));
    faces
        .filter(|&face| interface_of(uncut, face) == Some(interface))
        .flat_map(|face| {
            let corners = uncut.corners(face.cell());
            let [a, b, c, d] = FACES[face.face()].map(|i| uncut.rest(corners[i]));
            [[a, b, c], [a, c, d], [a, b, d], [b, c, d]]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{BladePoint, CutStroke, Material, block, cut};

    #[test]
    fn nodes_slide_in_flat_surfaces_and_drift_off_bent_ones() {
        let model = block([8, 7, 6], 4e-3, &Material::default(), 0);
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.0141, y, 0.006),
            axis: Vec3::new(0.3, 0.0, 1.0).normalize(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.05)],
            width_m: 0.0,
        };
        let uncut = Topology::new(model.clone().into());
        let mut flat = uncut.clone();
        cut(&mut flat, &stroke).unwrap();
        assert!(interface_drift_m(&uncut, &flat) < 1e-12);
        // The same cut topology, beside an original whose top is half a millimetre lower.
        let mut lower = model;
        for p in lower.nodes.iter_mut().filter(|p| p.z > 0.0239) {
            p.z -= 5e-4;
        }
        let drift = interface_drift_m(&Topology::new(lower.into()), &flat);
        assert!((drift - 5e-4).abs() < 1e-9, "{drift}");
    }
}
