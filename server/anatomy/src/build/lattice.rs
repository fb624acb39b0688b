//! From labelled cells to nodes and hexahedra: numbering, neighbours, opened faces.

use std::collections::{BTreeMap, BTreeSet};

use palpate_tissue::cell::{EDGES, FACES, NO_CELL};
use palpate_tissue::{Cell, RegionId};

use super::faces::OUTSIDE;
use super::grid::Grid;
use super::label::Labels;
use crate::surface::Sets;

/// No node stands at this grid point.
const NO_NODE: u32 = u32::MAX;

/// The numbered lattice.
#[derive(Debug)]
pub(super) struct Lattice {
    /// Grid point of each node. A node at opened faces has copies at the same point.
    pub(super) nodes: Vec<[i32; 3]>,
    /// Neighbour of each node along -x, +x, -y, +y, -z, +z, or `u32::MAX`.
    pub(super) adjacent: Vec<[u32; 6]>,
    /// The cells with their neighbours.
    pub(super) cells: Vec<Cell>,
    /// The opened faces: the two cells, and the face of the first one.
    pub(super) opened: Vec<([u32; 2], usize)>,
}

impl Lattice {
    /// For each opened face whether it may stay open: it opens, and, once this holds for all faces, neither the outer surface
    /// nor that of a region touches itself along an edge of the face, where more than two faces would meet.
    pub(super) fn may_stay_open(&self) -> Vec<bool> {
        let facing = self.facing();
        let opened = self.opened.iter();
        let opens: Vec<bool> = opened.map(|face| self.opens(face, &facing)).collect();
        if opens.contains(&false) {
            return opens;
        }
        let sides = |&(cells, face): &([u32; 2], usize)| {
            let sides = cells.into_iter().zip([face, face ^ 1]);
            sides.map(|(cell, face)| edges_of(&self.cells[cell as usize], face))
        };
        // The surfaces and the faces that meet at each edge.
        let edges = self.opened.iter().flat_map(sides).flatten();
        let mut uses: BTreeMap<[u32; 2], Vec<u16>> = edges.map(|e| (e, Vec::new())).collect();
        if uses.is_empty() {
            return Vec::new();
        }
        let nodes: BTreeSet<u32> = uses.keys().flatten().copied().collect();
        for cell in &self.cells {
            if !cell.corners.iter().any(|n| nodes.contains(n)) {
                continue;
            }
            for face in 0..6 {
                let other = cell.neighbours[face];
                let outer = other == NO_CELL;
                if !outer && self.cells[other as usize].region == cell.region {
                    continue;
                }
                for edge in edges_of(cell, face) {
                    if let Some(uses) = uses.get_mut(&edge) {
                        uses.push(cell.region.0);
                        uses.extend(outer.then_some(OUTSIDE));
                    }
                }
            }
        }
        let touches = |edge: [u32; 2]| {
            let uses = &uses[&edge];
            uses.iter()
                .any(|s| uses.iter().filter(|t| *t == s).count() > 2)
        };
        let opened = self.opened.iter();
        opened
            .map(|face| !sides(face).flatten().any(touches))
            .collect()
    }

    /// The nodes of the two sides of an opened face.
    pub(super) fn sides(&self, &(cells, face): &([u32; 2], usize)) -> [[u32; 4]; 2] {
        let corners = cells.map(|cell| self.cells[cell as usize].corners);
        [
            FACES[face].map(|c| corners[0][c]),
            FACES[face ^ 1].map(|c| corners[1][c]),
        ]
    }

    /// The sum of the outward directions of the opened faces at each of their nodes.
    pub(super) fn facing(&self) -> BTreeMap<u32, [i8; 3]> {
        let mut facing: BTreeMap<u32, [i8; 3]> = BTreeMap::new();
        for opened in &self.opened {
            for (nodes, face) in self.sides(opened).into_iter().zip([opened.1, opened.1 ^ 1]) {
                for node in nodes {
                    facing.entry(node).or_default()[face / 2] += outward(face);
                }
            }
        }
        facing
    }

    /// Whether each side of an opened face has a corner that the other side has not and that faces out of it. Without one
    /// nothing opens, or both sides would move along the face when they are parted.
    fn opens(&self, opened: &([u32; 2], usize), facing: &BTreeMap<u32, [i8; 3]>) -> bool {
        let [near, far] = self.sides(opened);
        let sides = [(near, far, opened.1), (far, near, opened.1 ^ 1)];
        sides.into_iter().all(|(own, other, face)| {
            let mut copied = own.iter().filter(|node| !other.contains(node));
            copied.any(|node| facing[node][face / 2].signum() == outward(face))
        })
    }

    /// Number of pieces of the model.
    pub(super) fn pieces(&self) -> usize {
        let mut sets = Sets::new(self.cells.len());
        let mut pieces = self.cells.len();
        for (cell, at) in self.cells.iter().zip(0..) {
            for &other in cell.neighbours.iter().filter(|o| **o != NO_CELL) {
                pieces -= usize::from(sets.join(at, other));
            }
        }
        pieces
    }
}

/// Numbers the nodes and cells of the model, x fastest, then y, then z. `open` holds the opened faces, see
/// [`super::gaps::Joints::open_faces`]. A node has one copy for each group of its cells that are connected through
/// faces at the node.
pub(super) fn number(grid: &Grid, labels: &Labels, open: &[usize]) -> Lattice {
    let points = grid.points();
    let point_index = |p: [usize; 3]| p[0] + points[0] * (p[1] + points[1] * p[2]);
    let corner = |at: [usize; 3], c: usize| {
        point_index([at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2 & 1)])
    };
    let is_open = |low: usize, axis: usize| open.binary_search(&(3 * low + axis)).is_ok();
    let mut node_at = vec![NO_NODE; points.iter().product()];
    let mut cell_number = vec![NO_CELL; grid.cell_count()];
    let mut inside = Vec::new();
    for (cell, &label) in labels.label.iter().enumerate() {
        if label != 0 {
            cell_number[cell] = inside.len() as u32;
            inside.push(cell);
            let at = cell_at(grid, cell);
            for c in 0..8 {
                node_at[corner(at, c)] = 0;
            }
        }
    }
    // The copy at each corner slot of the nodes of opened faces.
    let mut copies: BTreeMap<usize, [u8; 8]> = BTreeMap::new();
    for &face in open {
        let (at, axis) = (cell_at(grid, face / 3), face % 3);
        for c in FACES[2 * axis + 1] {
            let point: [usize; 3] = std::array::from_fn(|a| at[a] + (c >> a & 1));
            let fans = || fans(grid, labels, point, is_open);
            copies.entry(point_index(point)).or_insert_with(fans);
        }
    }
    let mut nodes = Vec::new();
    for (index, node) in node_at.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
        *node = nodes.len() as u32;
        let at = [
            index % points[0],
            index / points[0] % points[1],
            index / (points[0] * points[1]),
        ];
        let fans = copies.get(&index);
        let last = fans.and_then(|f| f.iter().filter(|f| **f != NO_FAN).max());
        for _ in 0..=last.copied().unwrap_or(0) {
            nodes.push(at.map(|i| i as i32));
        }
    }
    copies.retain(|_, fans| fans.iter().any(|f| *f != 0 && *f != NO_FAN));
    let mut adjacent = vec![[NO_NODE; 6]; nodes.len()];
    let mut cells = Vec::with_capacity(inside.len());
    for &cell in &inside {
        let at = cell_at(grid, cell);
        let corners: [u32; 8] = std::array::from_fn(|c| {
            let point = corner(at, c);
            let copy = if copies.is_empty() {
                None
            } else {
                copies.get(&point)
            };
            node_at[point] + copy.map_or(0, |fans| u32::from(fans[c]))
        });
        for [a, b] in EDGES {
            let axis = (a ^ b).trailing_zeros() as usize;
            adjacent[corners[a] as usize][2 * axis + 1] = corners[b];
            adjacent[corners[b] as usize][2 * axis] = corners[a];
        }
        let mut neighbours = face_neighbours(grid, cell)
            .map(|other| other.map_or(NO_CELL, |other| cell_number[other]));
        if !open.is_empty() {
            for (face, other) in face_neighbours(grid, cell).into_iter().enumerate() {
                if other.is_some_and(|other| is_open(cell.min(other), face / 2)) {
                    neighbours[face] = NO_CELL;
                }
            }
        }
        let region = RegionId(u16::from(labels.label[cell]) - 1);
        cells.push(Cell {
            corners,
            neighbours,
            region,
        });
    }
    let opened = open.iter().filter_map(|face| {
        let (cell, axis) = (face / 3, face % 3);
        let other = face_neighbours(grid, cell)[2 * axis + 1]?;
        Some(([cell, other].map(|c| cell_number[c]), 2 * axis + 1))
    });
    Lattice {
        nodes,
        adjacent,
        cells,
        opened: opened.collect(),
    }
}

/// The direction out of a face along its axis.
pub(super) fn outward(face: usize) -> i8 {
    if face % 2 == 1 { 1 } else { -1 }
}

/// The edges of a face as pairs of nodes, the lower number first.
fn edges_of(cell: &Cell, face: usize) -> [[u32; 2]; 4] {
    let nodes = FACES[face].map(|c| cell.corners[c]);
    std::array::from_fn(|e| {
        let [a, b] = [nodes[e], nodes[(e + 1) % 4]];
        [a.min(b), a.max(b)]
    })
}

/// Marks a slot without a cell.
const NO_FAN: u8 = u8::MAX;

/// Groups the cells around a grid point that are connected through faces at the point: the group of the cell at each
/// slot, from 0 in the order of slots. A cell is in slot `c` when the point is its corner `c`.
fn fans(
    grid: &Grid,
    labels: &Labels,
    point: [usize; 3],
    is_open: impl Fn(usize, usize) -> bool,
) -> [u8; 8] {
    let cells: [Option<usize>; 8] = std::array::from_fn(|c| {
        let at: [usize; 3] = std::array::from_fn(|a| point[a].wrapping_sub(c >> a & 1));
        let inside = (0..3).all(|a| at[a] < grid.cells[a]);
        let cell = inside.then(|| grid.cell_index(at));
        cell.filter(|cell| labels.label[*cell] != 0)
    });
    let mut fan: [u8; 8] = std::array::from_fn(|c| cells[c].map_or(NO_FAN, |_| c as u8));
    for axis in 0..3 {
        for low in (0..8).filter(|c| c >> axis & 1 == 1) {
            let high = low ^ (1 << axis);
            if let (Some(cell), Some(_)) = (cells[low], cells[high])
                && !is_open(cell, axis)
            {
                let [to, from] = [fan[low].min(fan[high]), fan[low].max(fan[high])];
                fan = fan.map(|f| if f == from { to } else { f });
            }
        }
    }
    // Numbers without gaps.
    let mut found: Vec<u8> = fan.iter().copied().filter(|f| *f != NO_FAN).collect();
    found.sort_unstable();
    found.dedup();
    fan.map(|f| found.binary_search(&f).map_or(NO_FAN, |n| n as u8))
}

pub(super) fn cell_at(grid: &Grid, index: usize) -> [usize; 3] {
    let [nx, ny, _] = grid.cells;
    [index % nx, index / nx % ny, index / (nx * ny)]
}

pub(super) fn face_neighbours(grid: &Grid, cell: usize) -> [Option<usize>; 6] {
    let at = cell_at(grid, cell);
    std::array::from_fn(|face| {
        let axis = face / 2;
        let mut to = at;
        if face % 2 == 1 {
            to[axis] += 1;
            (to[axis] < grid.cells[axis]).then(|| grid.cell_index(to))
        } else {
            to[axis] = to[axis].checked_sub(1)?;
            Some(grid.cell_index(to))
        }
    })
}
