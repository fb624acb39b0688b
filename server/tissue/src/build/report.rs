//! What a build reports, so that a model can be trusted.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::patch::Interfaces;
use super::relax::is_bad;
use crate::{Boundary, FACES, FaceId, Model, NO_CELL, Topology, Vec3};

/// One object with the figures of a build.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BuildReport {
    /// Number of nodes (mass points).
    pub nodes: usize,
    /// Number of hexahedral cells.
    pub cells: usize,
    /// Springs by kind.
    pub springs: SpringCounts,
    /// Lattice spacing in mm.
    pub spacing_mm: f64,
    /// One entry per region, in scene order.
    pub regions: Vec<RegionReport>,
    /// The outer surface.
    pub outer_surface: SurfaceReport,
    /// How well shaped the cells are.
    pub quality: QualityReport,
    /// Topology hash of the uncut model, hexadecimal.
    pub topology_hash: String,
    /// What a person should know, one sentence each.
    pub warnings: Vec<String>,
}

/// Springs by kind (Lin 2007, fig. 3.2), each counted once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SpringCounts {
    /// Along the edges of cells, within a tissue or within an interface.
    pub structural: usize,
    /// Across the faces and through the bodies of cells.
    pub shear: usize,
    /// Along the edges that join an interface to the next layer of nodes on either side.
    pub layer: usize,
}

/// A region of the model against its input surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionReport {
    /// Its name.
    pub name: String,
    /// Nodes of its cells, those on its interfaces included.
    pub nodes: usize,
    /// Volume of its cells in mm³.
    pub volume_mm3: f64,
    /// Volume of its input surface less what later regions take, in mm³.
    pub input_volume_mm3: f64,
    /// Mean distance of its interfaces from the input surfaces, in mm.
    pub surface_distance_mean_mm: f64,
    /// Largest such distance, in mm.
    pub surface_distance_max_mm: f64,
}

/// The outer surface as a triangle mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SurfaceReport {
    /// Number of vertices.
    pub vertices: usize,
    /// Number of triangles.
    pub triangles: usize,
    /// Whether every edge belongs to exactly two triangles.
    pub closed: bool,
    /// Number of connected parts.
    pub components: usize,
}

/// Shape of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QualityReport {
    /// Shortest spring in spacings.
    pub shortest_spring: f64,
    /// Cells of less than a fifth of a cube, or with a corner that is clearly inside out.
    pub bad_cells: usize,
    /// Cells of negative volume.
    pub inverted_cells: usize,
}

/// Counts springs by kind.
pub(super) fn count_springs(model: &Model, topology: &Topology) -> SpringCounts {
    let interface: Vec<bool> = (0..model.nodes.len() as u32)
        .map(|node| {
            let mut first = None;
            topology
                .cells_around(node)
                .into_iter()
                .filter(|&c| c != NO_CELL)
                .any(|c| {
                    let region = topology.region(c);
                    *first.get_or_insert(region) != region
                })
        })
        .collect();
    let mut counts = SpringCounts::default();
    for node in 0..model.nodes.len() {
        for spring in topology.springs().row(node as u32) {
            let to = spring.to as usize;
            if to < node {
                continue;
            }
            let step: i32 = (0..3)
                .map(|a| (model.lattice[node][a] - model.lattice[to][a]).abs())
                .sum();
            if step > 1 {
                counts.shear += 1;
            } else if interface[node] != interface[to] {
                counts.layer += 1;
            } else {
                counts.structural += 1;
            }
        }
    }
    counts
}

/// Compares each region with its input.
pub(super) fn report_regions(
    model: &Model,
    topology: &Topology,
    interfaces: &Interfaces,
    input_volumes: &[f64],
) -> Vec<RegionReport> {
    let mut volume = vec![0.0; model.regions.len()];
    let mut nodes_of: Vec<Vec<bool>> = vec![vec![false; model.nodes.len()]; model.regions.len()];
    for (index, cell) in model.cells.iter().enumerate() {
        volume[cell.region.index()] += topology.volume(index as u32);
        for node in cell.corners {
            nodes_of[cell.region.index()][node as usize] = true;
        }
    }
    (0..model.regions.len())
        .map(|r| {
            let (mean, max) = distance_to_input(model, topology, interfaces, r);
            RegionReport {
                name: model.regions[r].name.clone(),
                nodes: nodes_of[r].iter().filter(|&&on| on).count(),
                volume_mm3: volume[r] * 1e9,
                input_volume_mm3: input_volumes[r] * 1e9,
                surface_distance_mean_mm: mean * 1e3,
                surface_distance_max_mm: max * 1e3,
            }
        })
        .collect()
}

/// Mean and largest distance, in m, of the corners and middles of a region's interface faces from
/// the patches that they stand for.
fn distance_to_input(
    model: &Model,
    topology: &Topology,
    interfaces: &Interfaces,
    region: usize,
) -> (f64, f64) {
    let distances: Vec<f64> = (0..model.cells.len() as u32)
        .into_par_iter()
        .filter(|&c| topology.region(c).index() == region)
        .flat_map_iter(|c| (0..6).map(move |face| FaceId::new(c, face)))
        .flat_map_iter(|id| face_distances(model, topology, interfaces, id))
        .collect();
    if distances.is_empty() {
        return (0.0, 0.0);
    }
    let sum: f64 = distances.iter().sum();
    (
        sum / distances.len() as f64,
        distances.iter().copied().fold(0.0, f64::max),
    )
}

fn face_distances(
    model: &Model,
    topology: &Topology,
    interfaces: &Interfaces,
    id: FaceId,
) -> Vec<f64> {
    let across = topology.across(id);
    let region = topology.region(id.cell());
    let patch = if across == NO_CELL {
        &interfaces.outer
    } else if topology.region(across) == region {
        return Vec::new();
    } else {
        &interfaces.inner[region.index().max(topology.region(across).index())]
    };
    let corners = topology.corners(id.cell());
    let face = FACES[id.face()].map(|c| model.nodes[corners[c] as usize]);
    let middle = (face[0] + face[1] + face[2] + face[3]) / 4.0;
    let mut distances = Vec::with_capacity(5);
    for point in face.iter().chain([&middle]) {
        distances.extend(patch.nearest(point).map(|p: Vec3| (p - point).norm()));
    }
    distances
}

/// Counts the outer surface's vertices, edges and parts.
pub fn report_surface(boundary: &Boundary) -> SurfaceReport {
    let mut edges: Vec<[u32; 2]> = boundary
        .triangles
        .iter()
        .flat_map(|t| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]])
        .map(|[a, b]| [a.min(b), a.max(b)])
        .collect();
    edges.sort_unstable();
    let closed = edges.chunk_by(|a, b| a == b).all(|group| group.len() == 2);
    let mut parent: BTreeMap<u32, u32> = boundary
        .triangles
        .iter()
        .flatten()
        .map(|&v| (v, v))
        .collect();
    let mut components = parent.len();
    for [a, b] in edges {
        let (ra, rb) = (root(&mut parent, a), root(&mut parent, b));
        if ra != rb {
            parent.insert(ra.max(rb), ra.min(rb));
            components -= 1;
        }
    }
    SurfaceReport {
        vertices: parent.len(),
        triangles: boundary.triangles.len(),
        closed,
        components,
    }
}

/// Root of a vertex in a forest of merged vertices, with the path to it halved.
fn root(parent: &mut BTreeMap<u32, u32>, mut vertex: u32) -> u32 {
    while parent[&vertex] != vertex {
        let up = parent[&parent[&vertex]];
        parent.insert(vertex, up);
        vertex = up;
    }
    vertex
}

/// Looks at the shape of all cells and springs.
pub(super) fn report_quality(model: &Model, topology: &Topology) -> QualityReport {
    let cells = 0..model.cells.len();
    let bad_cells = cells
        .clone()
        .into_par_iter()
        .filter(|&c| is_bad(&model.corners_of(c), model.spacing_m))
        .count();
    let inverted_cells = cells.filter(|&c| topology.volume(c as u32) <= 0.0).count();
    let shortest = (0..model.nodes.len() as u32)
        .into_par_iter()
        .map(|n| {
            let springs = topology.springs().row(n).iter();
            springs
                .map(|s| f64::from(s.rest_length))
                .fold(f64::INFINITY, f64::min)
        })
        .reduce(|| f64::INFINITY, f64::min);
    QualityReport {
        shortest_spring: shortest / model.spacing_m,
        bad_cells,
        inverted_cells,
    }
}
