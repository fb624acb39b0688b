//! Smoothing a sheet: its nodes are spread over the swept surface before the cells around are made sound, and brought
//! nearer to it afterwards (not in Lin 2007).
//!
//! Where the lattice makes a step, snapping leaves the nodes of an edge in one place, and triangles of the wall as
//! slivers. Spreading moves each free node within the wall to the mean of its neighbours there and back to its height
//! over the swept surface (Laplacian smoothing). Nodes on its rim, interfaces and other walls stay in this step.
//!
//! Projections accept any place within a node's slab. Tightening then moves the nodes, one after the other, as far
//! towards the swept surface as their cells stay sound.

use super::freedom::Freedom;
use super::patch::Patch;
use super::ribbon::Ribbon;
use super::sheet_snap::{ON_RIBBON, SheetNode};
use crate::cell::NO_CELL;
use crate::{FaceId, Topology, Vec3};

/// Rounds of spreading; ten give the same angles.
const SPREAD_ROUNDS: usize = 2;
/// Rounds of tightening: the second moves nodes that waited for others.
const TIGHTEN_ROUNDS: usize = 2;
/// Parts of its way that a node tries.
const PARTS: [f64; 6] = [1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125];

/// Spreads the free nodes within a wall over the swept surface.
pub(crate) fn spread(
    topology: &Topology,
    sheet: &[FaceId],
    patch: &mut Patch,
    nodes: &mut [SheetNode],
    ribbon: &Ribbon,
) {
    let inner = inner_nodes(topology, sheet, nodes);
    for _ in 0..SPREAD_ROUNDS {
        for (n, neighbours) in &inner {
            let at = |&n: &u32| place_of(n, nodes, patch, topology);
            let mean = neighbours.iter().map(at).sum::<Vec3>() / neighbours.len() as f64;
            let node = &mut nodes[*n];
            let (Some((point, normal)), Some(foot)) = (node.plane, ribbon.nearest(&mean)) else {
                continue;
            };
            // Triangles of a blade that comes back may face the other way.
            let side = normal.dot(&foot.normal).signum();
            let height = (patch.at[*n] - point).dot(&normal);
            let to = foot.point + foot.normal * (side * height);
            if node.within_drift(to, patch.spacing) == to {
                patch.at[*n] = to;
                node.plane = Some((foot.point, foot.normal));
            }
        }
    }
}

/// Present place of a node: in the patch if it is of the sheet, else at rest.
fn place_of(node: u32, nodes: &[SheetNode], patch: &Patch, topology: &Topology) -> Vec3 {
    let index = nodes.binary_search_by_key(&node, |n| n.node);
    index.map_or_else(|_| topology.rest(node), |i| patch.at[i])
}

/// Free nodes of the sheet within a wall, each with its neighbours on the wall, once per face. The wall consists of the
/// sheet and of faces that earlier cuts opened; around each of its nodes it is one surface, with two faces at every edge.
fn inner_nodes(
    topology: &Topology,
    sheet: &[FaceId],
    nodes: &[SheetNode],
) -> Vec<(usize, Vec<u32>)> {
    let free = nodes.iter().enumerate();
    let free = free.filter(|(_, node)| node.freedom == Freedom::Free);
    let inner = free.filter_map(|(n, node)| {
        let mut neighbours = Vec::new();
        let cells = topology.node_cells[node.node as usize]
            .into_iter()
            .enumerate();
        for (slot, cell) in cells.filter(|(_, cell)| *cell != NO_CELL) {
            // Each face once, from its lower side along its axis.
            for axis in (0..3).filter(|axis| slot >> axis & 1 == 1) {
                let face = FaceId::new(cell, 2 * axis + 1);
                if topology.is_opened(face) || sheet.binary_search(&face).is_ok() {
                    let along = (0..3).filter(|&other| other != axis);
                    neighbours.extend(along.map(|a| topology.corners(cell)[slot ^ (1 << a)]));
                }
            }
        }
        let mut edges: Vec<u32> = neighbours.iter().map(|&n| topology.origin(n)).collect();
        edges.sort_unstable();
        let is_inner = edges.chunk_by(|a, b| a == b).all(|faces| faces.len() == 2);
        is_inner.then_some((n, neighbours))
    });
    inner.collect()
}

/// Moves the nodes of a sheet towards the swept surface, as far as cells stay sound, and no farther from interfaces.
pub(crate) fn tighten(patch: &mut Patch, nodes: &[SheetNode], ribbon: &Ribbon) {
    for _ in 0..TIGHTEN_ROUNDS {
        for (n, node) in nodes.iter().enumerate() {
            let from = patch.at[n];
            let Some(foot) = ribbon.nearest(&from) else {
                continue;
            };
            let off = foot.point - from;
            let way = match node.freedom {
                Freedom::Free => Some(off),
                Freedom::Held(_) => node.rise(&foot.normal).map(|r| r * off.dot(&foot.normal)),
                Freedom::Pinned => None,
            };
            let Some(way) = way.filter(|_| off.norm() > ON_RIBBON * patch.spacing) else {
                continue;
            };
            let lift = node.interfaces.distance(&from);
            for part in PARTS {
                let to = node.interfaces.clamp(from + way * part, lift);
                patch.at[n] = to;
                let mut around = patch.around[n].into_iter().filter(|&c| c != NO_CELL);
                let is_nearer = |foot: super::ribbon::Foot| (foot.point - to).norm() < off.norm();
                if node.within_drift(to, patch.spacing) == to
                    && around.all(|c| patch.is_sound(c as usize))
                    && node.interfaces.distance(&to) <= lift + ON_RIBBON * patch.spacing
                    && ribbon.nearest(&to).is_some_and(is_nearer)
                {
                    break;
                }
                patch.at[n] = from;
            }
        }
    }
}
