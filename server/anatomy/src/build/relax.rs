//! Restoring an even spacing after the snap (reconstructed).
//!
//! Interior nodes near an interface move towards the mean of their lattice neighbours; nodes on an
//! interface move towards the mean of those neighbours that lie on at least the same interfaces,
//! and are put back onto them.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::constraint::Constraint;
use super::interfaces::Interfaces;
use super::lattice::Lattice;
use super::snap::project_near;

/// Sweeps over the nodes. Ten restore the spacing to within a few percent of what more would.
const SWEEPS: usize = 10;
/// Layers of interior nodes beside an interface that move; deeper nodes are already regular.
const LAYERS: usize = 3;
/// Relaxation factor of one sweep; with a factor of 1 neighbours overshoot in turn.
const STEP: f64 = 0.5;

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
    // A node at the end of a curve has no neighbour to slide to.
    if count < 2.0 {
        return at;
    }
    let towards = at + (sum / count - at) * STEP;
    if constraint.free() {
        towards
    } else {
        // The node is on its interface, so the nearest point is no farther than the step.
        project_near(interfaces, constraint, towards, (towards - at).norm())
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
