//! Figures of the sheet that a cut opened: distances from the swept surface and from interfaces, and soundness of the cells.

use std::collections::BTreeMap;

use palpate_tissue::cell::{FACES, NO_CELL, PAIRS};
use palpate_tissue::nearest::{Feature, nearest_feature};
use palpate_tissue::{FaceId, RegionId, SweptSurface, Topology, Vec3};

/// Constraints on a node of a sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Kind {
    Inside,
    Interface,
    /// On bone, also the side that was parted from it.
    Pinned,
}

/// A node of a sheet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SheetNode {
    pub(crate) node: u32,
    pub(crate) kind: Kind,
    /// Distance from the swept surface in spacings.
    pub(crate) off: f64,
}

/// The node of the model as built that a node is or was doubled from.
pub(crate) fn origin(t: &Topology, node: u32) -> u32 {
    let cells = t.cells_around(node);
    let slot = cells.iter().position(|&c| c != NO_CELL).unwrap();
    t.model().cells[cells[slot] as usize].corners[slot]
}

/// Nodes of the sheet of faces that were opened since the boundary had `before` faces; one per doubled group.
pub(crate) fn sheet_nodes(
    uncut: &Topology,
    t: &Topology,
    before: usize,
    surface: &SweptSurface,
) -> Vec<SheetNode> {
    let mut nodes = BTreeMap::new();
    for face in &t.boundary().faces[before..] {
        for corner in FACES[face.face()] {
            let node = t.corners(face.cell())[corner];
            nodes.insert(origin(t, node), node);
        }
    }
    let spacing = t.model().spacing_m;
    let figures = nodes.into_iter().map(|(origin, node)| SheetNode {
        node,
        kind: if uncut.is_pinned(origin) {
            Kind::Pinned
        } else if interfaces_at(uncut, origin).is_empty() {
            Kind::Inside
        } else {
            Kind::Interface
        },
        off: surface.distance_m(&t.rest(node)).unwrap_or(f64::INFINITY) / spacing,
    });
    figures.collect()
}

type Interface = (RegionId, Option<RegionId>);

fn interface_of(t: &Topology, face: FaceId) -> Option<Interface> {
    let region = t.region(face.cell());
    match t.across(face) {
        NO_CELL => Some((region, None)),
        other => {
            let other = t.region(other);
            (other != region).then_some((region.min(other), Some(region.max(other))))
        }
    }
}

pub(crate) fn interfaces_at(uncut: &Topology, node: u32) -> Vec<Interface> {
    let mut found = Vec::new();
    for (slot, &cell) in uncut.cells_around(node).iter().enumerate() {
        if cell != NO_CELL {
            for axis in 0..3 {
                found.extend(interface_of(
                    uncut,
                    FaceId::new(cell, 2 * axis + (slot >> axis & 1)),
                ));
            }
        }
    }
    found.sort_unstable();
    found.dedup();
    found
}

/// Distance in spacings of a node from the farthest of its interfaces as built.
pub(crate) fn drift(uncut: &Topology, t: &Topology, node: u32) -> f64 {
    let origin = origin(t, node);
    let at = t.rest(node);
    let mut nodes = vec![origin];
    let mut cells = Vec::new();
    for _ in 0..3 {
        cells = nodes
            .iter()
            .flat_map(|&n| uncut.cells_around(n))
            .filter(|&c| c != NO_CELL)
            .collect();
        cells.sort_unstable();
        cells.dedup();
        nodes = cells.iter().flat_map(|&c| uncut.corners(c)).collect();
        nodes.sort_unstable();
        nodes.dedup();
    }
    let mut farthest: f64 = 0.0;
    for interface in interfaces_at(uncut, origin) {
        let mut nearest = f64::INFINITY;
        for face in cells
            .iter()
            .flat_map(|&c| (0..6).map(move |f| FaceId::new(c, f)))
        {
            if interface_of(uncut, face) == Some(interface) {
                let [a, b, c, d] =
                    FACES[face.face()].map(|i| uncut.rest(uncut.corners(face.cell())[i]));
                for corners in [[a, b, c], [a, c, d], [a, b, d], [b, c, d]] {
                    nearest = nearest.min((nearest_point(&at, &corners) - at).norm());
                }
            }
        }
        farthest = farthest.max(nearest);
    }
    farthest / uncut.model().spacing_m
}

fn nearest_point(p: &Vec3, corners: &[Vec3; 3]) -> Vec3 {
    match nearest_feature(p, corners) {
        Feature::Corner(i) => corners[i],
        Feature::Edge(i, j, part) => corners[i] + (corners[j] - corners[i]) * part,
        Feature::Face(weights) => {
            let sum: f64 = weights.iter().sum();
            (0..3).map(|i| corners[i] * (weights[i] / sum)).sum()
        }
    }
}

/// Least corner determinant (cubed spacings) and shortest spring (spacings) of a cell.
pub(crate) fn cell_figures(x: &[Vec3; 8], spacing: f64) -> [f64; 2] {
    let mut least = f64::INFINITY;
    for c in 0..8usize {
        let e = |a: usize| {
            let out = x[c ^ (1 << a)] - x[c];
            if c >> a & 1 == 0 { out } else { -out }
        };
        least = least.min(e(0).cross(&e(1)).dot(&e(2)) / spacing.powi(3));
    }
    let mut short = f64::INFINITY;
    for [a, b] in PAIRS {
        short = short.min((x[a] - x[b]).norm() / spacing);
    }
    [least, short]
}

/// Squared angles in degrees between adjacent triangles of the faces that were opened since the boundary had `before`
/// faces, where all corners are inside; both sides, without the front of the cut.
pub(crate) fn wall_angles(uncut: &Topology, t: &Topology, before: usize) -> Vec<f64> {
    let mut sides = BTreeMap::<[u32; 2], Vec<(FaceId, Vec3)>>::new();
    for (i, &[a, b, c]) in t.boundary().triangles.iter().enumerate().skip(2 * before) {
        let is_inside = |n: u32| {
            let node = origin(t, n);
            !uncut.is_pinned(node) && interfaces_at(uncut, node).is_empty()
        };
        if [a, b, c].into_iter().all(is_inside) {
            let at = |n| t.rest(n);
            let normal = (at(b) - at(a)).cross(&(at(c) - at(a)));
            for [p, q] in [[a, b], [b, c], [c, a]] {
                let edge = sides.entry([p.min(q), p.max(q)]).or_default();
                edge.push((t.boundary().faces[i / 2], normal));
            }
        }
    }
    let behind = |face: FaceId| {
        let cell = uncut.across(face);
        FaceId::new(cell, face.face() ^ 1)
    };
    let angle = |sides: &Vec<(FaceId, Vec3)>| match sides[..] {
        [(face, a), (other, b)] if other != behind(face) => Some(a.angle(&b).to_degrees()),
        _ => None,
    };
    sides.values().filter_map(angle).map(|a| a * a).collect()
}
