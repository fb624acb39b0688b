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
            shift(untangler, faces, interface, missing, positions);
        }
    }
}

fn shift(
    untangler: &Untangler<'_>,
    faces: &[Face],
    interface: Interface,
    missing: f64,
    positions: &mut [Vec3],
) {
    let mut normals: Vec<(u32, Vec3)> = Vec::new();
    let mut area = 0.0;
    for face in faces.iter().filter(|f| f.interface() == interface) {
        let [a, b, c, d] = face.corners(positions);
        let vector = (c - a).cross(&(d - b)) / 2.0;
        area += vector.norm();
        normals.extend(face.nodes.map(|n| (n, vector)));
    }
    if area == 0.0 {
        return;
    }
    // A stable sort, so that the normals of a node are summed in one order.
    normals.sort_by_key(|n| n.0);
    let reach = SHIFT_MAX * untangler.spacing();
    let distance = (missing / area).clamp(-reach, reach);
    let moves: Vec<(u32, Vec3)> = normals
        .chunk_by(|a, b| a.0 == b.0)
        .filter(|chunk| moves_alone(untangler.constraint(chunk[0].0), interface))
        .filter_map(|chunk| {
            let out = chunk.iter().map(|n| n.1).sum::<Vec3>().try_normalize(0.0)?;
            Some((chunk[0].0, out * distance))
        })
        .collect();
    untangler.move_while_it_holds(&moves, &TRIES, positions);
}

/// Nodes on several interfaces and on rims hold the others in place.
fn moves_alone(constraint: Constraint, interface: Interface) -> bool {
    constraint.single() && constraint.interfaces().next() == Some(interface)
}
