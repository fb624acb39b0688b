//! Bricks: two by two by two cells of the lattice, the unit in which forces are computed.
//!
//! A brick has up to 27 nodes and 158 springs. With the nodes in a row of length 27, the springs of
//! one direction join entry `i` with entry `i + offset` for one fixed offset, so eight springs at a
//! time are loads, arithmetic and stores without any gathering. Each cell brings its own share of
//! the stiffness of its springs, so a spring between two bricks is computed in both, with what their
//! cells give to it.
//!
//! Where a cut has doubled nodes, two cells can disagree about the node at the same place. They then go to two bricks,
//! so that only this module handles cuts. Cells with different spring curves go to different bricks too.

use pulp::Simd;

use super::corners::{SKEWED, STRENGTH};
use super::kernel::Aligned;
use super::lanes::LANES;
use super::law::{Curve, Elastic};
use crate::cell::PAIRS;
use crate::springs::LENGTH_FLOOR;
use crate::{Topology, Vec3, fit};

/// Nodes of a brick: 3 x 3 x 3.
pub(crate) const LOCALS: usize = 27;
/// The nodes of a brick in whole vectors.
pub(crate) const SPAN: usize = 32;
/// Springs per bit of [`Form::uses`].
const CHUNK: usize = 8;
/// Length of an array over the nodes of a brick, with room for loads beyond its end.
pub(crate) const PADDED: usize = 48;
/// Distances between the ends of a spring in a row of the brick's nodes, and the corresponding lattice steps.
const STEPS: [(usize, [i32; 3]); 13] = [
    (1, [1, 0, 0]),
    (3, [0, 1, 0]),
    (9, [0, 0, 1]),
    (4, [1, 1, 0]),
    (2, [-1, 1, 0]),
    (10, [1, 0, 1]),
    (8, [-1, 0, 1]),
    (12, [0, 1, 1]),
    (6, [0, -1, 1]),
    (13, [1, 1, 1]),
    (11, [-1, 1, 1]),
    (7, [1, -1, 1]),
    (5, [-1, -1, 1]),
];
/// Deviation from a lattice step, relative to the step, up to which cells count as cubes.
const REGULAR: f32 = 1e-5;
/// Directions of springs.
pub(crate) const DIRECTIONS: usize = STEPS.len();

/// Offset of each direction.
pub(crate) const OFFSETS: [usize; DIRECTIONS] = [1, 3, 9, 4, 2, 10, 8, 12, 6, 13, 11, 7, 5];

/// The direction with each offset.
const DIRECTION_OF: [usize; 14] = {
    let mut of = [0; 14];
    let mut direction = 0;
    while direction < DIRECTIONS {
        of[OFFSETS[direction]] = direction;
        direction += 1;
    }
    of
};

/// Entry of corner `c` of the cell at position `p` (0..8) of a brick.
pub(crate) const CORNER: [[usize; 8]; 8] = corners();

const fn corners() -> [[usize; 8]; 8] {
    let mut list = [[0; 8]; 8];
    let mut p = 0;
    while p < 8 {
        let mut c = 0;
        while c < 8 {
            let x = (p & 1) + (c & 1);
            let y = (p >> 1 & 1) + (c >> 1 & 1);
            let z = (p >> 2 & 1) + (c >> 2 & 1);
            list[p][c] = x + 3 * y + 9 * z;
            c += 1;
        }
        p += 1;
    }
    list
}

/// Relative lengths within which no spring of a plain form may be extreme.
const LENGTHS: [f32; 2] = [0.89, 1.1];

/// Everything but displacements that determines the forces of a brick; equal bricks share one form.
#[derive(Clone, PartialEq)]
pub(crate) struct Form {
    /// Rest positions from the middle of the brick in m.
    pub(crate) rest: Aligned<[[f32; PADDED]; 3]>,
    /// Stiffness of the springs of each direction in N/m, by the node that they start at.
    pub(crate) stiffness: Aligned<[[f32; SPAN]; DIRECTIONS]>,
    /// Their rest lengths in m.
    pub(crate) rest_length: Aligned<[[f32; SPAN]; DIRECTIONS]>,
    /// Bit `4 d + i / 8` is set when a spring of direction `d` starts at a node around `i`.
    used: u64,
    /// κ V0 of each cell in N m, and one over its determinant at rest, by the cell's first node (the volume term).
    pub(crate) bulk: [f32; LANES],
    pub(crate) per_volume: [f32; LANES],
    /// Modulus that hardens each cell's corners in Pa, by the cell's first node, and the
    /// volume of a cube of the lattice in m³; see `corners.rs`.
    pub(crate) corner: [f32; LANES],
    pub(crate) cell_volume: f32,
    /// Whether a corner that may harden is so skewed at rest that small strains flatten it.
    pub(crate) skewed: bool,
    /// Whether any cell has a volume term.
    pub(crate) has_bulk: bool,
    pub(crate) curve: Curve,
}

impl Form {
    /// Whether any of `width` springs of a direction exists from entry `from` on.
    #[inline(always)]
    pub(crate) fn uses(&self, direction: usize, from: usize, width: usize) -> bool {
        let chunks = (1 << width.div_ceil(CHUNK)) - 1;
        self.used >> (4 * direction + from / CHUNK) & chunks != 0
    }

    /// Whether all cells are cubes of the lattice.
    pub(crate) fn is_regular(&self, per_spacing: f32) -> bool {
        (0..DIRECTIONS).all(|d| {
            let (offset, step) = STEPS[d];
            let springs = self.stiffness[d][..LOCALS].iter().enumerate();
            springs.filter(|k| *k.1 > 0.0).all(|(i, _)| {
                (0..3).all(|a| {
                    let by = (self.rest[a][i + offset] - self.rest[a][i]) * per_spacing;
                    (by - step[a] as f32).abs() < REGULAR
                })
            })
        })
    }

    /// Whether its springs follow the length law alone at small strain.
    pub(super) fn is_plain(&self) -> bool {
        let [least, most] = self.curve.limits;
        !self.skewed && self.curve.stiffening == 0.0 && least < LENGTHS[0] && most > LENGTHS[1]
    }
}

/// A brick.
#[derive(Clone, Copy)]
pub(crate) struct Brick {
    /// Node at each entry; some node of the brick where an entry is empty.
    pub(crate) nodes: [u32; LOCALS],
    /// Bit `i` is set when entry `i` has a node.
    pub(crate) present: u32,
    /// Index of its [`Form`].
    pub(crate) form: u32,
}

/// Cells of one brick under construction.
pub(crate) struct Draft {
    pub(crate) nodes: [u32; LOCALS],
    pub(crate) curve: Curve,
    /// Cell at each position, or none.
    pub(crate) cells: [Option<u32>; 8],
}

const ABSENT: u32 = u32::MAX;

impl Draft {
    /// Distributes the cells of one place to as few bricks as their nodes and curves allow.
    pub(crate) fn of(topology: &Topology, cells: &[(usize, u32)], drafts: &mut Vec<Self>) {
        let first = drafts.len();
        for &(position, cell) in cells {
            let corners = topology.corners(cell);
            let curve =
                Curve::of(&topology.model().regions[topology.region(cell).index()].material);
            let fits = |draft: &Self| {
                draft.curve == curve
                    && draft.cells[position].is_none()
                    && corners
                        .iter()
                        .zip(CORNER[position])
                        .all(|(&node, i)| draft.nodes[i] == ABSENT || draft.nodes[i] == node)
            };
            let found = drafts[first..].iter().position(fits);
            let index = found.map_or(drafts.len(), |i| first + i);
            if index == drafts.len() {
                drafts.push(Self {
                    nodes: [ABSENT; LOCALS],
                    curve,
                    cells: [None; 8],
                });
            }
            let draft = &mut drafts[index];
            draft.cells[position] = Some(cell);
            for (&node, i) in corners.iter().zip(CORNER[position]) {
                draft.nodes[i] = node;
            }
        }
    }

    /// The brick; its form still needs a number.
    #[inline(always)]
    pub(crate) fn finish<S: Simd>(&self, simd: S, topology: &Topology) -> (Brick, Form) {
        let mut nodes = self.nodes;
        let mut present = 0;
        let some = nodes.iter().copied().find(|&n| n != ABSENT).unwrap_or(0);
        for (i, node) in nodes.iter_mut().enumerate() {
            if *node == ABSENT {
                *node = some;
            } else {
                present |= 1 << i;
            }
        }
        let brick = Brick {
            nodes,
            present,
            form: 0,
        };
        (brick, self.form(simd, topology, &nodes))
    }

    #[inline(always)]
    fn form<S: Simd>(&self, simd: S, topology: &Topology, nodes: &[u32; LOCALS]) -> Form {
        let spacing = topology.model().spacing_m;
        let places = nodes.map(|node| topology.rest(node));
        // In spacings first, so that cubes at different places have the same bits.
        let mut rest = Aligned([[0.0; PADDED]; 3]);
        for (i, place) in places.iter().enumerate() {
            let d = (place - places[0]) / spacing;
            for a in 0..3 {
                rest[a][i] = d[a] as f32 * spacing as f32;
            }
        }
        let mut springs = [[0.0f64; LOCALS]; DIRECTIONS];
        let (mut bulk, mut per_volume) = ([0.0; LANES], [0.0; LANES]);
        let mut corner = [0.0; LANES];
        let mut skewed = false;
        // Positions without a cell count as cubes.
        let mut corners = [[places[0]; 8]; fit::CELLS];
        for (position, _) in self.cells.iter().enumerate().filter(|c| c.1.is_some()) {
            corners[position] = CORNER[position].map(|i| places[i]);
        }
        let shares = fit::shares(simd, &corners, LENGTH_FLOOR * spacing);
        for (position, cell) in self.cells.iter().enumerate() {
            let Some(cell) = *cell else { continue };
            let elastic = topology.elastic(cell);
            let corners = corners[position];
            skewed |= self.curve.held && is_skewed(&corners);
            let energy = elastic.spring_pa * topology.volume(cell).max(0.0);
            let shares = shares.each_ref().map(|of| of[position]);
            let stiffness = spring_stiffness(&corners, elastic, energy, spacing, shares);
            for (k, [a, b]) in stiffness.into_iter().zip(PAIRS) {
                let (i, j) = (CORNER[position][a], CORNER[position][b]);
                springs[DIRECTION_OF[i.abs_diff(j)]][i.min(j)] += k;
            }
            if self.curve.held {
                let modulus = f64::from(STRENGTH) / 8.0 * elastic.spring_pa;
                corner[CORNER[position][0]] = modulus as f32;
            }
            let det = rest_determinant(&corners);
            if elastic.bulk_pa > 0.0 && det > 0.0 {
                let first = CORNER[position][0];
                bulk[first] = (elastic.bulk_pa * topology.volume(cell).max(0.0)) as f32;
                per_volume[first] = (1.0 / det.max(LENGTH_FLOOR * spacing.powi(3))) as f32;
            }
        }
        let mut stiffness = Aligned([[0.0; SPAN]; DIRECTIONS]);
        // One where no spring exists: the numerator is zero there.
        let mut rest_length = Aligned([[1.0; SPAN]; DIRECTIONS]);
        let mut used = 0;
        for (d, row) in stiffness.iter_mut().enumerate() {
            for (i, (to, k)) in row.iter_mut().zip(springs[d]).enumerate() {
                *to = k as f32;
                used |= u64::from(k > 0.0) << (4 * d + i / CHUNK);
            }
            let mut square = [0.0; SPAN];
            for axis in rest.iter() {
                for (i, square) in square.iter_mut().enumerate() {
                    let way = axis[i + OFFSETS[d]] - axis[i];
                    *square += way * way;
                }
            }
            // Without branches, so that it is vectorised.
            let lengths = &mut rest_length[d];
            for i in 0..SPAN {
                let length = square[i].sqrt().max(1e-10);
                lengths[i] = if row[i] > 0.0 { length } else { 1.0 };
            }
        }
        Form {
            rest,
            stiffness,
            rest_length,
            used,
            bulk,
            per_volume,
            corner,
            cell_volume: spacing.powi(3) as f32,
            skewed,
            has_bulk: bulk.iter().any(|&b| b > 0.0),
            curve: self.curve,
        }
    }
}

/// Whether the volume of any corner of a cell is less than [`SKEWED`] of its edges' product.
#[inline(always)]
fn is_skewed(p: &[Vec3; 8]) -> bool {
    (0..8).any(|c| {
        let [x, y, z] = [1, 2, 4].map(|step| p[c | step] - p[c & !step]);
        let square = x.norm_squared() * y.norm_squared() * z.norm_squared();
        let volume = x.dot(&y.cross(&z));
        volume < 0.0 || volume * volume < SKEWED * SKEWED * square
    })
}

/// Stiffness of the springs of a cell with these shares in N/m; see `springs.rs`. `energy` is modulus times volume.
#[inline(always)]
fn spring_stiffness(
    corners: &[Vec3; 8],
    elastic: &Elastic,
    energy: f64,
    spacing: f64,
    shares: [f64; PAIRS.len()],
) -> [f64; PAIRS.len()] {
    let floor = LENGTH_FLOOR * spacing;
    let ways = PAIRS.map(|[a, b]| corners[b] - corners[a]);
    let squares = ways.map(|way| way.norm_squared().max(floor * floor));
    let mut stiffness = shares;
    for (k, square) in stiffness.iter_mut().zip(squares) {
        *k *= energy / square;
    }
    if elastic.has_fibres() {
        for (k, way) in stiffness.iter_mut().zip(&ways) {
            *k *= elastic.fibre_factor(way);
        }
    }
    stiffness
}

/// Mean edges of a cell, as they enter the volume term: three vectors.
pub(crate) fn mean_edges(corners: &[Vec3; 8]) -> [Vec3; 3] {
    std::array::from_fn(|axis| {
        let mut sum = Vec3::zeros();
        for (c, p) in corners.iter().enumerate() {
            if c >> axis & 1 == 1 {
                sum += p;
            } else {
                sum -= p;
            }
        }
        sum / 4.0
    })
}

fn rest_determinant(corners: &[Vec3; 8]) -> f64 {
    let [a, b, c] = mean_edges(corners);
    a.dot(&b.cross(&c))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_spring_of_a_cell_has_a_direction() {
        for (offset, step) in STEPS {
            assert_eq!(
                OFFSETS[STEPS.iter().position(|s| s.0 == offset).unwrap()],
                offset
            );
            let index = step[0] + 3 * step[1] + 9 * step[2];
            assert_eq!(index, offset as i32);
        }
        for position in 0..8 {
            for a in 0..8 {
                for b in a + 1..8 {
                    let offset = CORNER[position][a].abs_diff(CORNER[position][b]);
                    assert!(STEPS.iter().any(|s| s.0 == offset), "{position} {a} {b}");
                }
            }
        }
        assert!(OFFSETS.iter().all(|o| o + SPAN <= PADDED));
    }
}
