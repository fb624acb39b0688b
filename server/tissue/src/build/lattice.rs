//! From labelled cells to nodes and hexahedra: mending the labels, numbering, neighbours.

use super::grid::Grid;
use super::label::Labels;
use crate::{Cell, EDGES, NO_CELL, RegionId};

/// No node stands at this grid point.
const NO_NODE: u32 = u32::MAX;

/// Passes over the grid in which mending may both fill and empty cells; real anatomy needs three.
/// After that cells are only emptied, which can not go round in circles.
const TWO_WAY_PASSES: usize = 10;

/// A piece with fewer cells than this part of the largest one is dropped, and reported.
const PIECE_MIN: f64 = 0.001;

/// What had to be done to the labels.
#[derive(Debug, Default)]
pub(super) struct Mending {
    /// Cells flipped so that the outer surface is a manifold.
    pub(super) flipped: usize,
    /// Number of pieces dropped as too small, and of cells in them.
    pub(super) dropped: (usize, usize),
    /// Number of pieces kept.
    pub(super) pieces: usize,
}

/// Whether the set bits of a 2x2x2 block are connected through faces (no bit at all counts as so).
fn connected(block: u8) -> bool {
    if block == 0 {
        return true;
    }
    let mut reached = 1_u8 << block.trailing_zeros();
    loop {
        let mut next = reached;
        for cell in 0..8 {
            if reached >> cell & 1 == 1 {
                for axis in 0..3 {
                    next |= 1 << (cell ^ (1 << axis));
                }
            }
        }
        next &= block;
        if next == reached {
            return reached == block;
        }
        reached = next;
    }
}

/// Whether the surface of the set cells of a block is a disc around its middle point.
fn manifold(block: u8) -> bool {
    connected(block) && connected(!block)
}

/// Flips the most doubtful cells until the surface of the model is a manifold: where two cells touch
/// along an edge or at a corner only, the outer surface could not be wound consistently.
pub(super) fn mend(grid: &Grid, labels: &mut Labels) -> Mending {
    let mut mending = Mending::default();
    for pass in 0.. {
        let mut flipped = 0;
        for k in 0..grid.cells[2] - 1 {
            for j in 0..grid.cells[1] - 1 {
                for i in 0..grid.cells[0] - 1 {
                    let cells = block_cells(grid, [i, j, k]);
                    let mut block = 0_u8;
                    for (bit, &cell) in cells.iter().enumerate() {
                        block |= u8::from(labels.label[cell] != 0) << bit;
                    }
                    if !manifold(block) {
                        flip_one(grid, labels, &cells, block, pass < TWO_WAY_PASSES);
                        flipped += 1;
                    }
                }
            }
        }
        mending.flipped += flipped;
        if flipped == 0 {
            break;
        }
    }
    mending
}

/// The eight cells around grid point `at + 1`.
fn block_cells(grid: &Grid, at: [usize; 3]) -> [usize; 8] {
    std::array::from_fn(|c| {
        grid.cell_index([at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2 & 1)])
    })
}

/// Flips the cell of a block that is nearest to half full, one whose flip makes the block a manifold
/// if there is one; without `fill` only an inside cell.
fn flip_one(grid: &Grid, labels: &mut Labels, cells: &[usize; 8], block: u8, fill: bool) {
    let inside = |c: usize| block >> c & 1 == 1;
    // The margin of the grid stays empty.
    let fillable = |c: usize| {
        let at = cell_at(grid, cells[c]);
        fill && (0..3).all(|a| at[a] != 0 && at[a] + 1 != grid.cells[a])
    };
    let doubt = |c: usize| (i32::from(labels.fill[cells[c]]) - 128).abs();
    let choice = (0..8)
        .filter(|&c| inside(c) || fillable(c))
        .min_by_key(|&c| (!manifold(block ^ (1 << c)), doubt(c), c));
    let Some(c) = choice else { return };
    let cell = cells[c];
    if inside(c) {
        labels.label[cell] = 0;
        labels.fill[cell] = 0;
    } else {
        labels.label[cell] = label_around(grid, labels, cell);
        labels.fill[cell] = 255;
    }
}

fn cell_at(grid: &Grid, index: usize) -> [usize; 3] {
    let [nx, ny, _] = grid.cells;
    [index % nx, index / nx % ny, index / (nx * ny)]
}

/// The commonest label among the cells that share a face with a cell.
fn label_around(grid: &Grid, labels: &Labels, cell: usize) -> u8 {
    let mut counts = [0_u8; 256];
    for other in face_neighbours(grid, cell).into_iter().flatten() {
        counts[labels.label[other] as usize] += 1;
    }
    (1..=255_u8)
        .max_by_key(|&l| (counts[l as usize], 255 - l))
        .unwrap_or(1)
}

fn face_neighbours(grid: &Grid, cell: usize) -> [Option<usize>; 6] {
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

/// Drops the pieces that are too small to be meant, and counts those that stay.
pub(super) fn drop_crumbs(grid: &Grid, labels: &mut Labels, mending: &mut Mending) {
    let mut piece_of = vec![0_u32; grid.cell_count()];
    let mut sizes = vec![0_usize];
    let mut stack = Vec::new();
    for seed in 0..grid.cell_count() {
        if labels.label[seed] == 0 || piece_of[seed] != 0 {
            continue;
        }
        let piece = sizes.len() as u32;
        sizes.push(0);
        piece_of[seed] = piece;
        stack.push(seed);
        while let Some(cell) = stack.pop() {
            sizes[piece as usize] += 1;
            for other in face_neighbours(grid, cell).into_iter().flatten() {
                if labels.label[other] != 0 && piece_of[other] == 0 {
                    piece_of[other] = piece;
                    stack.push(other);
                }
            }
        }
    }
    let least = (sizes.iter().copied().max().unwrap_or(0) as f64 * PIECE_MIN).ceil() as usize;
    for (cell, &piece) in piece_of.iter().enumerate() {
        if piece != 0 && sizes[piece as usize] < least {
            labels.label[cell] = 0;
            mending.dropped.1 += 1;
        }
    }
    mending.dropped.0 = sizes[1..].iter().filter(|&&s| s < least).count();
    mending.pieces = sizes.len() - 1 - mending.dropped.0;
}

/// The numbered lattice.
#[derive(Debug)]
pub(super) struct Lattice {
    /// Grid point of each node.
    pub(super) nodes: Vec<[usize; 3]>,
    /// Neighbour of each node along -x, +x, -y, +y, -z, +z, or `u32::MAX`.
    pub(super) adjacent: Vec<[u32; 6]>,
    /// The cells with their neighbours.
    pub(super) cells: Vec<Cell>,
}

/// Numbers the nodes and cells of the model, x fastest, then y, then z.
pub(super) fn number(grid: &Grid, labels: &Labels) -> Lattice {
    let points = grid.points();
    let point_index = |p: [usize; 3]| p[0] + points[0] * (p[1] + points[1] * p[2]);
    let corner = |at: [usize; 3], c: usize| {
        point_index([at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2 & 1)])
    };
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
    let mut nodes = Vec::new();
    for (index, node) in node_at.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
        *node = nodes.len() as u32;
        nodes.push([
            index % points[0],
            index / points[0] % points[1],
            index / (points[0] * points[1]),
        ]);
    }
    let mut adjacent = vec![[NO_NODE; 6]; nodes.len()];
    let mut cells = Vec::with_capacity(inside.len());
    for &cell in &inside {
        let at = cell_at(grid, cell);
        let corners: [u32; 8] = std::array::from_fn(|c| node_at[corner(at, c)]);
        for [a, b] in EDGES {
            let axis = (a ^ b).trailing_zeros() as usize;
            adjacent[corners[a] as usize][2 * axis + 1] = corners[b];
            adjacent[corners[b] as usize][2 * axis] = corners[a];
        }
        let neighbours = face_neighbours(grid, cell)
            .map(|other| other.map_or(NO_CELL, |other| cell_number[other]));
        let region = RegionId(u16::from(labels.label[cell]) - 1);
        cells.push(Cell {
            corners,
            neighbours,
            region,
        });
    }
    Lattice {
        nodes,
        adjacent,
        cells,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vec3;
    use proptest::prelude::*;

    #[test]
    fn two_cells_that_share_only_an_edge_or_a_corner_are_no_manifold() {
        assert!(manifold(0b1111_1111) && manifold(0) && manifold(0b0000_0001));
        assert!(manifold(0b0000_0011));
        assert!(!manifold(0b0000_1001));
        assert!(!manifold(0b1000_0001));
        assert!(!manifold(!0b1000_0001));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn mending_makes_any_labels_a_manifold(fill in prop::collection::vec(any::<u8>(), 512)) {
            let grid = Grid { origin: Vec3::zeros(), spacing: 1.0, cells: [10, 10, 10] };
            let mut labels = Labels { label: vec![0; 1000], fill: vec![0; 1000] };
            for (n, &f) in fill.iter().enumerate() {
                let cell = grid.cell_index([1 + n % 8, 1 + n / 8 % 8, 1 + n / 64]);
                labels.fill[cell] = f;
                labels.label[cell] = u8::from(f >= 128);
            }
            mend(&grid, &mut labels);
            for at in 0..9 * 9 * 9 {
                let cells = block_cells(&grid, [at % 9, at / 9 % 9, at / 81]);
                let mut block = 0;
                for (bit, &cell) in cells.iter().enumerate() {
                    block |= u8::from(labels.label[cell] != 0) << bit;
                }
                prop_assert!(manifold(block));
            }
        }
    }
}
