//! Closing opened faces at which triangles still pass through each other.
//!
//! Towards the end of a gap its two sides may not find room beside each other. The faces there are closed again, and all
//! nodes are placed again.

use std::collections::{BTreeMap, BTreeSet};

use super::faces::Face;
use super::lattice::Lattice;

/// Rings of faces around a pair of crossing triangles in which an opened face is closed.
const RINGS: usize = 3;

/// The opened faces to close, as indices into [`Lattice::opened`]: those in the pairs, else the nearest ones. `crossing`
/// has the two faces of each pair of triangles.
pub(super) fn crossed(lattice: &Lattice, faces: &[Face], crossing: &[[u32; 2]]) -> BTreeSet<usize> {
    if crossing.is_empty() {
        return BTreeSet::new();
    }
    let opened: BTreeMap<[u32; 4], usize> = (0..)
        .zip(&lattice.opened)
        .flat_map(|(index, face)| lattice.sides(face).map(|nodes| (nodes, index)))
        .collect();
    let sides = |pair: &[u32; 2]| {
        let side = |f: u32| opened.get(&faces[f as usize].nodes).copied();
        pair.map(side)
    };
    let near: BTreeSet<usize> = crossing.iter().flat_map(sides).flatten().collect();
    if !near.is_empty() || opened.is_empty() {
        return near;
    }
    let of_pairs = crossing.iter().flatten();
    let mut nodes: BTreeSet<u32> = of_pairs.flat_map(|f| faces[*f as usize].nodes).collect();
    for _ in 0..RINGS {
        let touches = |corners: &[u32; 4]| corners.iter().any(|n| nodes.contains(n));
        let near: BTreeSet<usize> = (opened.iter().filter(|(corners, _)| touches(corners)))
            .map(|(_, index)| *index)
            .collect();
        if !near.is_empty() {
            return near;
        }
        let ring = faces.iter().map(|f| f.nodes).filter(touches);
        let ring: Vec<u32> = ring.flatten().collect();
        nodes.extend(ring);
    }
    BTreeSet::new()
}
