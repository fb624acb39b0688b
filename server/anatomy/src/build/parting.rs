//! Parting triangles of interfaces that pass through each other.
//!
//! Cells above the quality floors are sound at their corners, but two triangles of their warped faces may still pass
//! through each other, and no floor holds for an empty cell between two faces. Nodes of such triangles move towards
//! their lattice points, where every cell is a cube, in small steps that keep the floors. Where that is not enough, the
//! nodes around them move too. Copies of a node beside a gap have one lattice point, so triangles there stay.

use std::collections::{BTreeMap, BTreeSet};

use palpate_tissue::Vec3;

use super::faces::Face;
use super::surface_faults::crossing_faces;
use super::untangle::{FLOOR, Untangler};

/// Part of the way to the lattice point in a round.
const STEP: f64 = 0.1;
/// Rounds with the same rings of nodes around the triangles, from none on, and most rounds.
const ROUNDS_PER_RING: usize = 4;
const ROUNDS: usize = 4 * ROUNDS_PER_RING;
/// Side in spacings of the cubes around moved nodes in which triangles are tested again: no triangle is as long.
const NEAR: f64 = 4.0;

/// The outcome.
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
    let mut crossing = crossing_faces(faces, positions, spacing);
    let before = crossing.clone();
    // The places before, of nodes that moved.
    let mut moved = BTreeMap::new();
    for round in 0..ROUNDS {
        let corners = |pair: &[u32; 2]| pair.map(|f| faces[f as usize].nodes).into_iter().flatten();
        let beside_gap = |node: u32| untangler.constraint(node).beside_gap();
        let movable = crossing
            .iter()
            .filter(|pair| !corners(pair).any(beside_gap));
        let mut nodes: Vec<u32> = movable.flat_map(corners).collect();
        if nodes.is_empty() {
            break;
        }
        nodes.sort_unstable();
        nodes.dedup();
        for _ in 0..round / ROUNDS_PER_RING {
            nodes = untangler.with_neighbours(&nodes);
        }
        nodes.retain(|node| !beside_gap(*node));
        let from: Vec<Vec3> = nodes.iter().map(|n| positions[*n as usize]).collect();
        let ways = nodes.iter().zip(&from);
        let ways: Vec<(u32, Vec3)> = ways
            .map(|(&node, at)| (node, (untangler.lattice_point(node) - at) * STEP))
            .collect();
        untangler.move_while_it_holds(&ways, FLOOR, positions);
        for (&node, at) in nodes.iter().zip(from) {
            if positions[node as usize] != at {
                moved.entry(node).or_insert(at);
            }
        }
        nodes.extend(moved.keys());
        nodes.extend(crossing.iter().flat_map(corners));
        let near = near(faces, &nodes, positions, spacing);
        let here: Vec<Face> = near.iter().map(|f| faces[*f as usize]).collect();
        let found = crossing_faces(&here, positions, spacing);
        crossing = (found.into_iter())
            .map(|pair| pair.map(|f| near[f as usize]))
            .collect();
    }
    if crossing.len() >= before.len() {
        for (node, at) in std::mem::take(&mut moved) {
            positions[node as usize] = at;
        }
        crossing = before;
    }
    Parted {
        moved: moved.into_keys().collect(),
        crossing,
    }
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
    use super::super::tests::{ball, built};
    use super::super::{BuildReport, SurfaceReport};
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

    fn surfaces(report: &BuildReport) -> impl Iterator<Item = &SurfaceReport> {
        let regions = report.regions.iter().map(|r| &r.surface);
        std::iter::once(&report.outer_surface).chain(regions)
    }

    #[test]
    fn no_surface_of_bumpy_layers_passes_through_itself() {
        let cases = [(5.0, 5.0), (11.0, 6.0)];
        let found = cases.map(|(waves, spacing)| {
            let [skin, fat, muscle] = [1.0, 0.9, 0.7].map(|part| bumpy(0.04 * part, waves, 0.3));
            let regions = [("skin", skin), ("fat", fat), ("muscle", muscle)];
            let (_, report) = built(spacing, &regions);
            assert_eq!(report.quality.bad_cells, 0);
            let faults = surfaces(&report).map(|s| s.edges_not_two + s.self_intersections);
            faults.sum::<usize>()
        });
        assert_eq!(found, [0, 0]);
    }
}
