//! Giving every region back the volume that straight cell faces have cut off its curved interfaces
//! (reconstructed).
//!
//! Faces between nodes that lie exactly on a curved surface run inside it: a bone of radius 7 mm
//! loses 6 % at a spacing of 4 mm. So the nodes of each interface move along its normal by
//! (missing volume) / (area), which is well below a tenth of the spacing; a node whose cells would
//! suffer moves less.

use super::faces::{Face, volumes};
use super::patch::Interface;
use super::snap::Constraint;
use super::untangle::Untangler;
use crate::Vec3;

/// Most rounds of correction; later ones take up what nodes that had to stay have left over. Three are
/// enough for a limb, a skin of one cell's thickness takes eight.
const ROUNDS_MAX: usize = 8;
/// Correction ends when every region is within this part of its volume.
const EXACT: f64 = 1e-4;
/// Farthest that an interface is moved in all, in spacings; a skin thinner than a cell needs a third.
/// A region that misses more volume than this gives has lost thin parts, and blowing up the rest
/// would be a lie.
const SHIFT_MAX: f64 = 0.4;
/// The same for one round, so that the interface's normals are still its own.
const STEP_MAX: f64 = 0.1;
/// Parts of the way that are tried until the cells around a node hold.
const TRIES: [f64; 3] = [1.0, 0.5, 0.25];

/// Moves the nodes of curved interfaces outwards until region volumes match `targets` (m³).
pub(super) fn restore_volumes(
    untangler: &Untangler<'_>,
    faces: &[Face],
    targets: &[f64],
    positions: &mut [Vec3],
) {
    let mut slots = Slots::new(faces, positions.len());
    // Signed distance that each interface has moved; the outer one counts as the first region's.
    let mut shifted = vec![0.0; targets.len()];
    for _ in 0..ROUNDS_MAX {
        let mut missing_most: f64 = 0.0;
        // Innermost (last) regions first, the outer surface at the end: each takes from the one
        // around it, so one pass settles nested regions.
        for region in (0..targets.len()).rev() {
            let volumes = volumes(faces, positions, targets.len());
            let (interface, target, missing) = if region == 0 {
                let whole: f64 = targets.iter().sum();
                (Interface::Outer, whole, whole - volumes.iter().sum::<f64>())
            } else {
                let missing = targets[region] - volumes[region];
                (Interface::Of(region), targets[region], missing)
            };
            if target > 0.0 {
                missing_most = missing_most.max((missing / target).abs());
            }
            let so_far = &mut shifted[region];
            slots.shift(untangler, faces, interface, missing, so_far, positions);
        }
        if missing_most <= EXACT {
            break;
        }
    }
}

/// A place for the normal of every node that lies on an interface.
struct Slots {
    slot_of: Vec<u32>,
    nodes: Vec<u32>,
    normals: Vec<Vec3>,
}

impl Slots {
    fn new(faces: &[Face], node_count: usize) -> Self {
        let mut slot_of = vec![u32::MAX; node_count];
        let mut nodes = Vec::new();
        for node in faces.iter().flat_map(|f| f.nodes) {
            let slot = &mut slot_of[node as usize];
            if *slot == u32::MAX {
                *slot = nodes.len() as u32;
                nodes.push(node);
            }
        }
        let normals = vec![Vec3::zeros(); nodes.len()];
        Self {
            slot_of,
            nodes,
            normals,
        }
    }

    /// Moves the nodes of one interface outwards by what is missing (m³), as far as the distance it
    /// has moved before leaves room.
    fn shift(
        &mut self,
        untangler: &Untangler<'_>,
        faces: &[Face],
        interface: Interface,
        missing: f64,
        shifted: &mut f64,
        positions: &mut [Vec3],
    ) {
        self.normals.fill(Vec3::zeros());
        let mut area = 0.0;
        for face in faces.iter().filter(|f| f.interface() == interface) {
            let [a, b, c, d] = face.corners(positions);
            let vector = (c - a).cross(&(d - b)) / 2.0;
            area += vector.norm();
            for node in face.nodes {
                self.normals[self.slot_of[node as usize] as usize] += vector;
            }
        }
        if area == 0.0 {
            return;
        }
        let [step, most] = [STEP_MAX, SHIFT_MAX].map(|part| part * untangler.spacing());
        let distance = (missing / area).clamp(-step, step);
        let distance = (*shifted + distance).clamp(-most, most) - *shifted;
        *shifted += distance;
        let moves: Vec<(u32, Vec3)> = self
            .nodes
            .iter()
            .zip(&self.normals)
            .filter(|(node, _)| moves_alone(untangler.constraint(**node), interface))
            .filter_map(|(node, normal)| Some((*node, normal.try_normalize(0.0)? * distance)))
            .collect();
        untangler.move_while_it_holds(&moves, &TRIES, positions);
    }
}

/// Nodes on several interfaces and on rims hold the others in place.
fn moves_alone(constraint: Constraint, interface: Interface) -> bool {
    constraint.single() && constraint.interfaces().next() == Some(interface)
}
