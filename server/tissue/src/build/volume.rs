//! Giving every region back the volume that straight cell faces have cut off its curved interfaces
//! (reconstructed).
//!
//! Faces between nodes that lie exactly on a curved surface run inside it: a bone of radius 7 mm
//! loses 6 % at a spacing of 4 mm. So the nodes of each interface move along its normal by
//! (missing volume) / (area), which is well below a tenth of the spacing.

use super::lattice::Lattice;
use super::snap::Constraint;
use crate::{FACES, NO_CELL, Vec3, cell_volume};

/// Most rounds of correction. Nodes on rims and on several interfaces stay, so that each round leaves
/// a part to the next; two are enough for a limb, a skin of one cell's thickness takes eight.
const ROUNDS_MAX: usize = 8;
/// Correction ends when every region is within this part of its volume.
const EXACT: f64 = 1e-3;
/// Farthest that an interface is moved in all, in spacings; a skin thinner than a cell needs a third.
/// A region that misses more volume than this gives has lost thin parts, and blowing up the rest
/// would be a lie.
const SHIFT_MAX: f64 = 0.4;
/// The same for one round, so that the interface's normals are still its own.
const STEP_MAX: f64 = 0.1;

/// One interface of the model: the outer surface, or where region `r` overrides others.
#[derive(Clone, Copy, PartialEq)]
enum Interface {
    Outer,
    Of(usize),
}

/// Moves the nodes of curved interfaces outwards until region volumes match `targets` (m³).
pub(super) fn restore_volumes(
    lattice: &Lattice,
    constraints: &[Constraint],
    targets: &[f64],
    spacing: f64,
    positions: &mut [Vec3],
) {
    // Signed distance that each interface has moved: region by region, the outer surface at the end.
    let mut shifted = vec![0.0; targets.len() + 1];
    for _ in 0..ROUNDS_MAX {
        let mut missing_most: f64 = 0.0;
        // Innermost (last) regions first, the outer surface at the end: each takes from the one
        // around it, so one pass settles nested regions.
        for region in (0..targets.len()).rev() {
            let (interface, whole, missing, slot) = if region == 0 {
                let whole: f64 = targets.iter().sum();
                let missing = whole - volume(lattice, positions, |_| true);
                (Interface::Outer, whole, missing, targets.len())
            } else {
                let missing = targets[region] - volume(lattice, positions, |r| r == region);
                (Interface::Of(region), targets[region], missing, region)
            };
            missing_most = missing_most.max((missing / whole).abs());
            shifted[slot] += shift(
                lattice,
                constraints,
                interface,
                missing,
                spacing,
                shifted[slot],
                positions,
            );
        }
        if missing_most <= EXACT {
            break;
        }
    }
}

fn volume(lattice: &Lattice, positions: &[Vec3], counts: impl Fn(usize) -> bool) -> f64 {
    let cells = lattice.cells.iter().filter(|c| counts(c.region.index()));
    cells
        .map(|c| cell_volume(&c.corners.map(|n| positions[n as usize])))
        .sum()
}

/// Moves the nodes of one interface outwards by what is missing, as far as `shifted`, the distance
/// it has moved before, leaves room; returns by how much.
fn shift(
    lattice: &Lattice,
    constraints: &[Constraint],
    interface: Interface,
    missing: f64,
    spacing: f64,
    shifted: f64,
    positions: &mut [Vec3],
) -> f64 {
    let mut normal = vec![Vec3::zeros(); positions.len()];
    let mut area = 0.0;
    for cell in &lattice.cells {
        for face in 0..6 {
            let across = cell.neighbours[face];
            let belongs = match interface {
                Interface::Outer => across == NO_CELL,
                Interface::Of(region) => {
                    across != NO_CELL
                        && cell.region.index() == region
                        && lattice.cells[across as usize].region.index() < region
                }
            };
            if belongs {
                let corners = FACES[face].map(|c| cell.corners[c] as usize);
                let [a, b, c, d] = corners.map(|n| positions[n]);
                let vector = (c - a).cross(&(d - b)) / 2.0;
                area += vector.norm();
                for n in corners {
                    normal[n] += vector;
                }
            }
        }
    }
    if area == 0.0 {
        return 0.0;
    }
    let (step, most) = (STEP_MAX * spacing, SHIFT_MAX * spacing);
    let distance = (missing / area).clamp(-step, step);
    let distance = (shifted + distance).clamp(-most, most) - shifted;
    for (node, constraint) in constraints.iter().enumerate() {
        let alone = match interface {
            Interface::Outer => constraint.outer && constraint.owners == 0,
            Interface::Of(region) => !constraint.outer && constraint.owners == 1 << region,
        };
        // Nodes on several interfaces and on rims hold the others in place.
        if alone
            && !constraint.rim
            && let Some(out) = normal[node].try_normalize(0.0)
        {
            positions[node] += out * distance;
        }
    }
    distance
}
