//! Figures of a cut topology.

use std::collections::{BTreeMap, BTreeSet};

use palpate_anatomy::surface::crossings;
use palpate_tissue::cell::{FACES, NO_CELL, PAIRS, scaled_jacobian};
use palpate_tissue::{CutOutcome, FaceId, SweptSurface, Topology};

use super::report::{BoundaryFigures, Component};
use super::walls::wall_faces;

const MM: f64 = 1e3;
const MM3: f64 = 1e9;

pub(super) fn volume_mm3(topology: &Topology) -> f64 {
    let cells = 0..topology.cell_count() as u32;
    cells.map(|c| topology.volume(c)).sum::<f64>() * MM3
}

pub(super) fn mass_kg(topology: &Topology) -> f64 {
    let nodes = 0..topology.node_count() as u32;
    nodes.map(|n| topology.mass(n)).sum()
}

/// Nodes and volume of each connected component of the cells, the largest first.
pub(super) fn components(topology: &Topology) -> Vec<Component> {
    let mut seen = vec![false; topology.cell_count()];
    let mut found = Vec::new();
    for start in 0..topology.cell_count() as u32 {
        if std::mem::replace(&mut seen[start as usize], true) {
            continue;
        }
        let (mut volume, mut nodes) = (0.0, Vec::new());
        let mut stack = vec![start];
        while let Some(cell) = stack.pop() {
            volume += topology.volume(cell);
            nodes.extend(topology.corners(cell));
            for face in (0..6).map(|f| FaceId::new(cell, f)) {
                let next = topology.across(face);
                if next != NO_CELL && !std::mem::replace(&mut seen[next as usize], true) {
                    stack.push(next);
                }
            }
        }
        nodes.sort_unstable();
        nodes.dedup();
        found.push(Component {
            nodes: nodes.len(),
            volume_mm3: volume * MM3,
        });
    }
    found.sort_by(|a, b| b.volume_mm3.total_cmp(&a.volume_mm3));
    found
}

pub(super) fn boundary(topology: &Topology) -> BoundaryFigures {
    let triangles = &topology.boundary().triangles;
    let sides = triangles
        .iter()
        .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
    let mut edges: Vec<[u32; 2]> = sides.map(|[a, b]| [a.min(b), a.max(b)]).collect();
    edges.sort_unstable();
    let uses = edges.chunk_by(|a, b| a == b);
    let edges_not_two = uses.filter(|uses| uses.len() != 2).count();
    BoundaryFigures {
        closed: edges_not_two == 0,
        edges_not_two,
        self_intersections: crossings(triangles, |n| topology.rest(n), topology.model().spacing_m)
            .len(),
    }
}

/// Cells that are inside out at a corner or as a whole.
pub(super) fn inverted_cells(topology: &Topology) -> usize {
    let cells = 0..topology.cell_count() as u32;
    let is_inverted = |&cell: &u32| {
        let corners = topology.corners(cell).map(|n| topology.rest(n));
        topology.volume(cell) <= 0.0 || scaled_jacobian(&corners) <= 0.0
    };
    cells.filter(is_inverted).count()
}

pub(super) fn shortest_spring_mm(topology: &Topology) -> f64 {
    let cells = 0..topology.cell_count() as u32;
    let squares = cells.flat_map(|cell| {
        let x = topology.corners(cell).map(|n| topology.rest(n));
        PAIRS.map(|[a, b]| (x[a] - x[b]).norm_squared())
    });
    squares.fold(f64::INFINITY, f64::min).sqrt() * MM
}

/// Triangles of the walls of wounds, by the region whose tissue they show.
pub(super) fn wound_triangles(topology: &Topology) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for face in wall_faces(topology) {
        let region = &topology.model().regions[topology.region(face.cell()).index()];
        *counts.entry(region.name.clone()).or_insert(0) += 2;
    }
    counts
}

/// Largest distance in mm from the swept surface of a node of the sheet that the last cut opened. Nodes of pinned
/// regions do not move, and tissue parts from them where they are: both are left out.
pub(super) fn path_distance_mm(
    topology: &Topology,
    outcome: &CutOutcome,
    surface: &SweptSurface,
) -> f64 {
    let faces = &topology.boundary().faces;
    let opened = &faces[faces.len() - 2 * outcome.faces_opened..];
    let nodes = opened.iter().flat_map(|face| {
        let corners = topology.corners(face.cell());
        FACES[face.face()].map(|i| corners[i])
    });
    let doubled = outcome.doubled.iter();
    let from_bone = doubled.filter(|d| topology.is_pinned(d.1)).map(|d| d.0);
    let from_bone: BTreeSet<u32> = from_bone.collect();
    let free = nodes.filter(|n| !topology.is_pinned(*n) && !from_bone.contains(n));
    let distances = free.filter_map(|n| surface.distance_m(&topology.rest(n)));
    distances.fold(0.0, f64::max) * MM
}
