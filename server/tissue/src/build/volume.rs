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

/// Rounds of correction; later ones take up what nodes that had to stay have left over.
const ROUNDS: usize = 3;
/// Farthest that a node is moved in one round, in spacings. A region that misses more volume than
/// this gives has lost thin parts, and blowing up the rest would be a lie.
const SHIFT_MAX: f64 = 0.1;
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
    for _ in 0..ROUNDS {
        // Innermost (last) regions first, the outer surface at the end: each takes from the one
        // around it, so one pass settles nested regions.
        for region in (0..targets.len()).rev() {
            let volumes = volumes(faces, positions, targets.len());
            let (interface, missing) = if region == 0 {
                let whole = targets.iter().sum::<f64>() - volumes.iter().sum::<f64>();
                (Interface::Outer, whole)
            } else {
                (Interface::Of(region), targets[region] - volumes[region])
            };
            slots.shift(untangler, faces, interface, missing, positions);
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

    fn shift(
        &mut self,
        untangler: &Untangler<'_>,
        faces: &[Face],
        interface: Interface,
        missing: f64,
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
        let reach = SHIFT_MAX * untangler.spacing();
        let distance = (missing / area).clamp(-reach, reach);
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
