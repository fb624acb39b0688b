//! Snapping the nodes of a sheet onto the swept surface (Lin 2007, figs 5.3 to 5.6; reconstructed).
//!
//! With q the nearest point of the swept surface, n the direction to it and d its distance, a free
//! node goes to q. A node on a surface or an interface may only slide along it: with P the projector
//! onto the directions left to it, it goes
//!
//! ```text
//! x <- x + P n d / |P n|²
//! ```
//!
//! which meets the surface's tangent plane, a few times over for curved ones. P comes from the
//! normals m of the faces that hold the node: directions along which the mean of m mᵀ is small are
//! free, so a node slides within a face, along a crease, and stays in a corner.
//!
//! Where the lattice makes a step, three corners of a cell would come to lie on one line: the last
//! of them stops as its cell allows, and counts as short.

use nalgebra::{Matrix3, SymmetricEigen};

use super::bounded_moves::Moves;
use super::ribbon::{Foot, Ribbon};
use crate::cell::{FACES, NO_CELL};
use crate::{FaceId, Topology, Vec3};

/// Farthest a node is snapped, in spacings: half the diagonal of a cell.
const SNAP_MAX: f64 = 0.87;
/// A snapped node is nearer to the swept surface than this, in spacings.
pub(crate) const ON_RIBBON: f64 = 1e-6;
/// Directions with a larger share of the normals than this are held: faces that meet at more than
/// about 37 degrees make a crease.
const HELD_SHARE: f64 = 0.1;
/// A node slides to the swept surface only where it crosses its own at more than this (squared sine
/// of the angle); flatter than that it would have to go too far.
const CROSSING_MIN: f64 = 0.05;
/// Steps of the iteration on curved surfaces; flat ones need one.
const ITERATIONS: usize = 6;
/// Rounds in which nodes that fell short spread along the cut and try again.
const ROUNDS: usize = 4;

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

pub(crate) struct SheetNode {
    pub(crate) node: u32,
    pub(crate) freedom: Freedom,
    start: Vec3,
    neighbours: Vec<u32>,
    pub(crate) short: bool,
}

/// The directions left to a node by the surfaces it lies on, old cuts among them.
pub(crate) fn freedom(topology: &Topology, node: u32) -> Freedom {
    if topology.is_pinned(node) {
        return Freedom::Pinned;
    }
    let cells = topology.node_cells[node as usize];
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

/// The nodes of a sheet: those on surfaces and interfaces first, then those inside.
pub(crate) fn sheet_nodes(topology: &Topology, sheet: &[FaceId]) -> Vec<SheetNode> {
    let mut links = std::collections::BTreeMap::<u32, Vec<u32>>::new();
    for &face in sheet {
        let nodes = super::sheet::nodes_of(topology, face);
        for i in 0..4 {
            links.entry(nodes[i]).or_default().push(nodes[(i + 1) % 4]);
            links.entry(nodes[i]).or_default().push(nodes[(i + 3) % 4]);
        }
    }
    let mut nodes: Vec<SheetNode> = links
        .into_iter()
        .map(|(node, mut neighbours)| {
            neighbours.sort_unstable();
            neighbours.dedup();
            SheetNode {
                node,
                freedom: freedom(topology, node),
                start: topology.rest(node),
                neighbours,
                short: false,
            }
        })
        .collect();
    nodes.sort_by_key(|n| (n.freedom == Freedom::Free, n.node));
    nodes
}

/// Snaps all nodes of a sheet as far as their cells allow.
pub(crate) fn snap(moves: &mut Moves<'_>, ribbon: &Ribbon, nodes: &mut [SheetNode]) {
    for node in nodes.iter_mut() {
        approach(moves, ribbon, node);
    }
    for _ in 0..ROUNDS {
        retry(moves, ribbon, nodes);
    }
}

/// Lets the nodes that are short spread along the cut, and try again.
pub(crate) fn retry(moves: &mut Moves<'_>, ribbon: &Ribbon, nodes: &mut [SheetNode]) {
    for node in nodes.iter().filter(|n| n.short) {
        spread(moves, ribbon, node);
    }
    for node in nodes.iter_mut().filter(|n| n.short) {
        approach(moves, ribbon, node);
    }
}

fn approach(moves: &mut Moves<'_>, ribbon: &Ribbon, node: &mut SheetNode) {
    let spacing = moves.topology.model.spacing_m;
    if node.freedom == Freedom::Pinned {
        return;
    }
    let from = moves.rest(node.node);
    if let Some(target) = target(ribbon, from, node.freedom, spacing) {
        let way = target - node.start;
        let limit = SNAP_MAX * spacing;
        let target = if way.norm() > limit {
            node.start + way * (limit / way.norm())
        } else {
            target
        };
        moves.advance(node.node, target);
    }
    let at = moves.rest(node.node);
    let foot = ribbon.nearest(&at);
    node.short = foot.is_none_or(|f| (f.point - at).norm() > ON_RIBBON * spacing);
}

/// Where a node meets the ribbon.
fn target(ribbon: &Ribbon, from: Vec3, freedom: Freedom, spacing: f64) -> Option<Vec3> {
    let mut x = from;
    for _ in 0..ITERATIONS {
        let foot = ribbon.nearest(&x)?;
        let way = foot.point - x;
        let d = way.norm();
        if d < 1e-10 * spacing {
            break;
        }
        match freedom {
            Freedom::Free => return Some(foot.point),
            Freedom::Pinned => return None,
            Freedom::Held(free) => {
                let slide = free * (way / d);
                let share = slide.norm_squared();
                if share < CROSSING_MIN {
                    return None;
                }
                x += slide * (d / share);
            }
        }
    }
    Some(x)
}

/// Half-way towards the mean of the neighbours in the sheet, along the cut only.
fn spread(moves: &mut Moves<'_>, ribbon: &Ribbon, node: &SheetNode) {
    let from = moves.rest(node.node);
    let Some(Foot { normal, .. }) = ribbon.nearest(&from) else {
        return;
    };
    let sum: Vec3 = node.neighbours.iter().map(|&n| moves.rest(n)).sum();
    let way = sum / node.neighbours.len() as f64 - from;
    let along = way - normal * normal.dot(&way);
    let along = match node.freedom {
        Freedom::Free => along,
        Freedom::Pinned => return,
        Freedom::Held(free) => {
            // Along the line in which the cut meets the surface.
            let held = free * along;
            let across = free * normal;
            let size = across.norm_squared();
            if size > CROSSING_MIN {
                held - across * (held.dot(&across) / size)
            } else {
                held
            }
        }
    };
    moves.advance(node.node, from + along * 0.5);
}
