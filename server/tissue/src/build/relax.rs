//! Restoring an even spacing after the snap, and mending cells that it has spoiled (reconstructed).
//!
//! Interior nodes near an interface move towards the mean of their lattice neighbours; nodes on an
//! interface move towards the mean of those neighbours that lie on at least the same interfaces,
//! and are put back onto them. Then cells whose worst corner is too flat pull their nodes in, off
//! the interface where nothing else helps.

use rayon::prelude::*;

use super::lattice::Lattice;
use super::patch::Interfaces;
use super::snap::{Constraint, project};
use crate::Vec3;

/// Sweeps over the nodes. Ten restore the spacing to within a few percent of what more would.
const SWEEPS: usize = 10;
/// Layers of interior nodes beside an interface that move; further in, nothing is out of place.
const LAYERS: usize = 3;
/// Part of the way towards the mean in one sweep; the full way makes neighbours overshoot in turn.
const STEP: f64 = 0.5;
/// Rounds of mending, each of which looks at the bad cells only.
const MENDING_ROUNDS: usize = 30;
/// Of those, the first ones keep nodes on rims and on interfaces, the next ones let go of rims.
const ROUNDS_ON_RIM: usize = 6;
/// Up to here nodes stay on their interfaces; after it they may leave them a little.
const ROUNDS_ON_SURFACE: usize = 16;
/// A cell is bad when its volume is below this part of Δd³.
pub(super) const VOLUME_MIN: f64 = 0.2;
/// A cell is bad when a corner spans less than this part of Δd³. Corners that the lattice shows as a
/// step and the interface does not are flat (0) by nature, and a little below on hollow interfaces.
pub(super) const CORNER_MIN: f64 = -0.1;
/// A cell is bad when an edge or a face diagonal is shorter than this part of Δd.
pub(super) const EDGE_MIN: f64 = 0.3;
/// Farthest that mending may take a node off its interface, in spacings.
const OFF_SURFACE_MAX: f64 = 0.15;

/// Relaxes the node positions in place.
pub(super) fn relax(
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraints: &[Constraint],
    positions: &mut [Vec3],
) {
    let moving = nodes_near_interfaces(lattice, constraints);
    for _ in 0..SWEEPS {
        let moved: Vec<(u32, Vec3)> = moving
            .par_iter()
            .map(|&node| {
                (
                    node,
                    relaxed(lattice, interfaces, constraints, positions, node),
                )
            })
            .collect();
        for (node, at) in moved {
            positions[node as usize] = at;
        }
    }
}

fn relaxed(
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraints: &[Constraint],
    positions: &[Vec3],
    node: u32,
) -> Vec3 {
    let at = positions[node as usize];
    let constraint = constraints[node as usize];
    let mut sum = Vec3::zeros();
    let mut count = 0.0;
    for &other in &lattice.adjacent[node as usize] {
        if other != u32::MAX
            && (constraint.free() || constraint.within(constraints[other as usize]))
        {
            sum += positions[other as usize];
            count += 1.0;
        }
    }
    // A node at the end of a curve has nowhere to slide to.
    if count < 2.0 {
        return at;
    }
    let towards = at + (sum / count - at) * STEP;
    if constraint.free() {
        towards
    } else {
        project(interfaces, constraint, towards)
    }
}

/// Nodes on an interface, and interior ones within [`LAYERS`] of one, in order.
fn nodes_near_interfaces(lattice: &Lattice, constraints: &[Constraint]) -> Vec<u32> {
    let mut layer: Vec<u8> = constraints.iter().map(|c| u8::from(!c.free())).collect();
    for depth in 1..=LAYERS as u8 {
        for node in 0..layer.len() {
            if layer[node] == 0 {
                let near = lattice.adjacent[node]
                    .iter()
                    .any(|&o| o != u32::MAX && layer[o as usize] == depth);
                if near {
                    layer[node] = depth + 1;
                }
            }
        }
    }
    (0..layer.len() as u32)
        .filter(|&n| layer[n as usize] != 0)
        .collect()
}

/// Volume spanned by the three edges at the worst corner of a cell, in m³.
pub(super) fn worst_corner(corners: &[Vec3; 8]) -> f64 {
    (0..8)
        .map(|c| {
            let edge = |axis: usize| {
                let to = corners[c ^ (1 << axis)] - corners[c];
                if c >> axis & 1 == 1 { -to } else { to }
            };
            edge(0).dot(&edge(1).cross(&edge(2)))
        })
        .fold(f64::INFINITY, f64::min)
}

/// Whether a cell is too thin or too twisted to carry springs well.
pub(super) fn is_bad(corners: &[Vec3; 8], spacing: f64) -> bool {
    let cube = spacing.powi(3);
    let short = |[a, b]: [usize; 2]| {
        (corners[a] - corners[b]).norm_squared() < (EDGE_MIN * spacing).powi(2)
    };
    crate::cell_volume(corners) < VOLUME_MIN * cube
        || worst_corner(corners) < CORNER_MIN * cube
        || crate::EDGES.into_iter().chain(crate::DIAGONALS).any(short)
}

/// Pulls the nodes of bad cells towards the middle of their neighbours until no cell is bad or no
/// round helps; returns the number of cells that stay bad.
pub(super) fn mend_cells(
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraints: &[Constraint],
    spacing: f64,
    positions: &mut [Vec3],
) -> usize {
    let bad_among = |cells: &[u32], positions: &[Vec3]| -> Vec<u32> {
        let corners = |c: u32| {
            lattice.cells[c as usize]
                .corners
                .map(|n| positions[n as usize])
        };
        cells
            .par_iter()
            .copied()
            .filter(|&c| is_bad(&corners(c), spacing))
            .collect()
    };
    let all: Vec<u32> = (0..lattice.cells.len() as u32).collect();
    let mut bad = bad_among(&all, positions);
    if bad.is_empty() {
        return 0;
    }
    let mut around = vec![[u32::MAX; 8]; positions.len()];
    for (index, cell) in lattice.cells.iter().enumerate() {
        for (c, &node) in cell.corners.iter().enumerate() {
            around[node as usize][c] = index as u32;
        }
    }
    for round in 0..MENDING_ROUNDS {
        if bad.is_empty() {
            break;
        }
        let mut nodes: Vec<u32> = bad
            .iter()
            .flat_map(|&c| lattice.cells[c as usize].corners)
            .collect();
        nodes.sort_unstable();
        nodes.dedup();
        let off_max = if round < ROUNDS_ON_SURFACE {
            0.0
        } else {
            OFF_SURFACE_MAX * spacing
        };
        for &node in &nodes {
            let mut constraint = constraints[node as usize];
            constraint.rim &= round < ROUNDS_ON_RIM;
            positions[node as usize] =
                pulled_in(lattice, interfaces, constraint, off_max, positions, node);
        }
        let mut touched: Vec<u32> = nodes.iter().flat_map(|&n| around[n as usize]).collect();
        touched.sort_unstable();
        touched.dedup();
        touched.retain(|&c| c != u32::MAX);
        bad = bad_among(&touched, positions);
    }
    bad.len()
}

fn pulled_in(
    lattice: &Lattice,
    interfaces: &Interfaces,
    constraint: Constraint,
    off_max: f64,
    positions: &[Vec3],
    node: u32,
) -> Vec3 {
    let at = positions[node as usize];
    let neighbours = lattice.adjacent[node as usize]
        .iter()
        .filter(|&&o| o != u32::MAX);
    let (sum, count) = neighbours.fold((Vec3::zeros(), 0.0), |(s, n), &o| {
        (s + positions[o as usize], n + 1.0)
    });
    if count == 0.0 {
        return at;
    }
    let towards = at + (sum / count - at) * 0.3;
    if constraint.free() {
        return towards;
    }
    let on_surface = project(interfaces, constraint, towards);
    let off = towards - on_surface;
    if off.norm() <= off_max {
        towards
    } else {
        on_surface + off.normalize() * off_max
    }
}
