//! Smoothing a sheet: its nodes are spread over the swept surface before the cells around are made sound, and brought
//! nearer to it afterwards (Lin 2007, fig. 5.10, "cut nodes only tangentially"; reconstructed).
//!
//! Where the lattice makes a step, snapping leaves the nodes of an edge in one place, and triangles of the wall as
//! slivers. Spreading moves each free node within the sheet to the mean of its neighbours there and back to its height
//! over the swept surface (Laplacian smoothing). Nodes on its rim, interfaces and walls stay.
//!
//! Projections let a node off the surface wherever it is within its slab. Tightening then moves the nodes, one after the
//! other, as far towards the surface as their cells stay sound.

use super::freedom::Freedom;
use super::patch::Patch;
use super::projections::DRIFT_ALLOWED;
use super::ribbon::Ribbon;
use super::sheet::nodes_of;
use super::sheet_snap::{ON_RIBBON, SheetNode};
use crate::cell::NO_CELL;
use crate::{FaceId, Topology, Vec3};

/// Rounds of spreading; ten give the same angles.
const SPREADINGS: usize = 2;
/// Rounds of tightening: the second moves nodes that waited for others.
const TIGHTENINGS: usize = 2;
/// Halvings of a way that is too long.
const HALVINGS: i32 = 5;

/// Spreads the free nodes within a sheet over the swept surface.
pub(crate) fn spread(
    topology: &Topology,
    sheet: &[FaceId],
    patch: &mut Patch,
    nodes: &mut [SheetNode],
    ribbon: &Ribbon,
) {
    let neighbours = inner_neighbours(topology, sheet, nodes);
    for _ in 0..SPREADINGS {
        for (n, around) in neighbours.iter().enumerate() {
            let at = |&n: &u32| place_of(n, nodes, patch, topology);
            let sum: Vec3 = around.iter().map(at).sum();
            let mean = sum / around.len() as f64;
            let (Some((point, normal)), false) = (nodes[n].plane, around.is_empty()) else {
                continue;
            };
            let height = (patch.at[n] - point).dot(&normal);
            let Some(foot) = ribbon.nearest(&mean) else {
                continue;
            };
            let to = foot.point + foot.normal * height;
            if nodes[n].within_drift(to, patch.spacing) == to {
                patch.at[n] = to;
                nodes[n].plane = Some((foot.point, foot.normal));
            }
        }
    }
}

/// Where a node is.
fn place_of(node: u32, nodes: &[SheetNode], patch: &Patch, topology: &Topology) -> Vec3 {
    let index = nodes.binary_search_by_key(&node, |n| n.node);
    index.map_or_else(|_| topology.rest(node), |i| patch.at[i])
}

/// Neighbours of each free node on the wall, once per face; none for other nodes and for those on its rim. The wall consists
/// of the sheet and of faces that earlier parts of a stroke opened.
fn inner_neighbours(topology: &Topology, sheet: &[FaceId], nodes: &[SheetNode]) -> Vec<Vec<u32>> {
    let of_node = |node: &SheetNode| {
        if node.freedom != Freedom::Free {
            return Vec::new();
        }
        let faces = faces_below(topology, node.node);
        let faces = faces.filter(|f| topology.is_opened(*f) || sheet.binary_search(f).is_ok());
        let mut around = Vec::new();
        for face in faces {
            let ring = nodes_of(topology, face);
            let at = ring
                .iter()
                .position(|&n| n == node.node)
                .expect("a corner of its face");
            around.extend([ring[(at + 1) % 4], ring[(at + 3) % 4]]);
        }
        let mut edges: Vec<u32> = around.iter().map(|&n| topology.origin(n)).collect();
        edges.sort_unstable();
        let is_inner = edges.chunk_by(|a, b| a == b).all(|faces| faces.len() > 1);
        if is_inner { around } else { Vec::new() }
    };
    nodes.iter().map(of_node).collect()
}

/// Faces at a node, each from its lower side along its axis.
fn faces_below(topology: &Topology, node: u32) -> impl Iterator<Item = FaceId> {
    let cells = topology.node_cells[node as usize].into_iter().enumerate();
    let cells = cells.filter(|(_, cell)| *cell != NO_CELL);
    cells.flat_map(|(slot, cell)| {
        let axes = (0..3).filter(move |axis| slot >> axis & 1 == 1);
        axes.map(move |axis| FaceId::new(cell, 2 * axis + 1))
    })
}

/// Moves the nodes of a sheet towards the swept surface, as far as cells stay sound, and no farther from interfaces.
pub(crate) fn tighten(patch: &mut Patch, nodes: &[SheetNode], ribbon: &Ribbon) {
    for _ in 0..TIGHTENINGS {
        for (n, node) in nodes.iter().enumerate() {
            let from = patch.at[n];
            let Some(foot) = ribbon.nearest(&from) else {
                continue;
            };
            let height = (from - foot.point).dot(&foot.normal);
            let Some(rise) = node.rise(&foot.normal) else {
                continue;
            };
            if height.abs() <= ON_RIBBON * patch.spacing {
                continue;
            }
            let drift = node.interfaces.distance(&from);
            let is_allowed = |patch: &Patch| {
                let mut around = patch.around[n].into_iter().filter(|&c| c != NO_CELL);
                around.all(|c| patch.is_sound(c as usize))
                    && node.interfaces.distance(&patch.at[n])
                        <= drift.max(DRIFT_ALLOWED * patch.spacing)
            };
            for halvings in 0..=HALVINGS {
                let to = from - rise * (height * 0.5_f64.powi(halvings));
                let to = node.interfaces.clamp(to, drift);
                patch.at[n] = node.within_drift(to, patch.spacing);
                if is_allowed(patch) {
                    break;
                }
                patch.at[n] = from;
            }
        }
    }
}
