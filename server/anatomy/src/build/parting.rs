//! Parting triangles of interfaces that pass through each other.
//!
//! Cells above the quality floors are sound at their corners, but two triangles of their warped faces may still pass
//! through each other, and no floor holds for an empty cell between two faces. The corners of such triangles first move
//! to the plane that separates the two with the shortest way ([`separations`]), while the floors hold.
//! Where floors or neighbours prevent that, the nodes of the pair and more and more around them move half way to their
//! lattice points, and the cells around are untangled again: in the limit all cells there are cubes, and the two sides of
//! a gap are apart.

use std::collections::BTreeSet;

use palpate_tissue::Vec3;

use super::faces::Face;
use super::surface_faults::crossing_triangles;
use super::untangle::{FLOOR, Untangler};
use crate::surface::separations;

/// Rounds in which triangles are separated by planes.
const SEPARATIONS: usize = 8;
/// Distance in spacings that each side keeps from the plane.
const MARGIN: f64 = 0.02;
/// Rounds in which nodes move half way to their lattice points, and those with the same rings of nodes around a pair.
const HALVINGS: usize = 12;
const HALVINGS_PER_RING: usize = 2;
/// Side in spacings of the cubes around moved nodes in which triangles are tested again: no triangle is as long.
const NEAR: f64 = 4.0;

/// The outcome.
#[derive(Default)]
pub(super) struct Parted {
    /// Nodes that moved, sorted.
    pub(super) moved: Vec<u32>,
    /// The two faces of each pair of triangles that still pass through each other.
    pub(super) crossing: Vec<[u32; 2]>,
}

/// Moves nodes until no two triangles of interfaces pass through each other. If fewer do not result, no node moves.
pub(super) fn part_crossings(
    untangler: &Untangler<'_>,
    faces: &[Face],
    positions: &mut [Vec3],
) -> Parted {
    let spacing = untangler.spacing();
    let found = crossing_triangles(faces, positions, spacing);
    if found.is_empty() {
        return Parted::default();
    }
    let before = positions.to_vec();
    let mut crossing = found.clone();
    for round in 0..SEPARATIONS + HALVINGS {
        if let Some(halving) = round.checked_sub(SEPARATIONS) {
            let mut nodes = corners(faces, &crossing);
            for _ in 0..halving / HALVINGS_PER_RING {
                nodes = untangler.with_neighbours(&nodes);
            }
            untangler.move_half_way(&nodes, positions);
        } else {
            let triangle = |t: u32| faces[t as usize / 2].triangles(positions)[t as usize % 2];
            let pairs = crossing.iter().map(|pair| pair.map(triangle));
            let steps = separations(pairs, |n| positions[n as usize], MARGIN * spacing);
            untangler.move_while_it_holds(&steps, FLOOR, positions);
        }
        let mut changed = moved(&before, positions);
        changed.extend(corners(faces, &crossing));
        let near = near(faces, &changed, positions, spacing);
        let here: Vec<Face> = near.iter().map(|f| faces[*f as usize]).collect();
        crossing = (crossing_triangles(&here, positions, spacing).into_iter())
            .map(|pair| pair.map(|t| 2 * near[t as usize / 2] + t % 2))
            .collect();
        if crossing.is_empty() {
            break;
        }
    }
    if crossing.len() >= found.len() {
        positions.copy_from_slice(&before);
        crossing = found;
    }
    Parted {
        moved: moved(&before, positions),
        crossing: (crossing.into_iter())
            .map(|pair| pair.map(|t| t / 2))
            .collect(),
    }
}

/// The corners of the faces of some pairs of triangles, sorted.
fn corners(faces: &[Face], pairs: &[[u32; 2]]) -> Vec<u32> {
    let of_pair = |pair: &[u32; 2]| pair.map(|t| faces[t as usize / 2].nodes);
    let mut nodes: Vec<u32> = pairs.iter().flat_map(of_pair).flatten().collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

/// The nodes that are not where they were, sorted.
fn moved(before: &[Vec3], positions: &[Vec3]) -> Vec<u32> {
    let places = (0..).zip(before.iter().zip(positions));
    let moved = places.filter(|(_, (from, to))| from != to);
    moved.map(|(node, _)| node).collect()
}

/// The faces near some nodes.
fn near(faces: &[Face], nodes: &[u32], positions: &[Vec3], spacing: f64) -> Vec<u32> {
    let cube = |node: u32| {
        let at = positions[node as usize] / (NEAR * spacing);
        <[i32; 3]>::from(at.map(|x| x.floor() as i32))
    };
    let around = |[x, y, z]: [i32; 3]| {
        let beside = |x: i32| x - 1..=x + 1;
        beside(x).flat_map(move |x| beside(y).flat_map(move |y| beside(z).map(move |z| [x, y, z])))
    };
    let cubes: BTreeSet<[i32; 3]> = nodes.iter().flat_map(|n| around(cube(*n))).collect();
    (0..faces.len() as u32)
        .filter(|f| cubes.contains(&cube(faces[*f as usize].nodes[0])))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{ball, built, surface_faults};
    use crate::Surface;

    /// A ball with bumps of a part of its radius.
    fn bumpy(radius: f64, waves: f64, part: f64) -> Surface {
        let mut surface = ball(radius);
        for p in &mut surface.vertices {
            let angles = p.normalize() * waves;
            let bump = angles.x.sin() * (angles.y + 1.0).sin() * (angles.z + 2.0).sin();
            *p *= 1.0 + part * bump;
        }
        surface
    }

    #[test]
    fn no_surface_of_bumpy_layers_passes_through_itself() {
        // The last two have layers thinner than a cell.
        let cases = [
            (5.0, 5.0, 0.9),
            (11.0, 6.0, 0.9),
            (7.0, 6.0, 0.95),
            (9.0, 5.0, 0.94),
        ];
        let found = cases.map(|(waves, spacing, part)| {
            let inner = if part > 0.9 { 0.9 } else { 0.7 };
            let [skin, fat, muscle] = [1.0, part, inner].map(|r| bumpy(0.04 * r, waves, 0.3));
            let regions = [("skin", skin), ("fat", fat), ("muscle", muscle)];
            let (_, report) = built(spacing, &regions);
            assert_eq!(report.quality.bad_cells, 0);
            surface_faults(&report)
        });
        assert_eq!(found, [0; 4]);
    }
}
