//! Repair of the labels of cells: every region gets a surface that is a manifold, and crumbs are dropped.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bridge;
use super::grid::Grid;
use super::label::Labels;
use super::lattice::{cell_at, face_neighbours};
use super::parts::ClosedParts;
use super::walls::Walls;
use crate::Aabb;

/// Passes over the grid in which repair may both fill and empty cells; real anatomy needs three. After that
/// cells are only emptied, which cannot cycle.
const TWO_WAY_PASSES: usize = 10;

/// A piece with fewer cells than this part of the largest one is dropped, and reported.
const PIECE_MIN: f64 = 0.001;

/// A region's islands of fewer cells than this are given to the surrounding regions, because nothing of that
/// size can be pressed.
const ISLAND_MIN: usize = 4;
/// The same as a part of the region's largest piece.
const ISLAND_PART: f64 = 0.001;
/// Most rounds: given-away islands can leave edges that touch, and repairing these can make islands.
const ROUNDS: usize = 4;
/// Most dropped pieces whose position is kept; beyond it they are only counted.
const PLACES_MAX: usize = 4096;

/// A piece of a region that was given to its surroundings.
#[derive(Debug, Clone)]
pub(super) struct Crumb {
    pub(super) label: u8,
    /// Its new label.
    pub(super) given: u8,
    /// Its cells in the grid.
    pub(super) cells: Vec<[usize; 3]>,
}

/// Repairs made to the labels.
#[derive(Debug, Default)]
pub(super) struct Mending {
    /// Cells flipped so that the outer surface is a manifold.
    pub(super) flipped_outer: usize,
    /// Cells flipped so that the surface of every region is one.
    pub(super) flipped_inner: usize,
    /// Number of pieces dropped as too small, and of cells in them.
    pub(super) dropped: (usize, usize),
    /// Their positions, at most [`PLACES_MAX`].
    pub(super) crumbs: Vec<Crumb>,
}

/// Restores thin layers, repairs faults and drops pieces until nothing changes. `parts` are the boxes around
/// the closed parts of each region's input; an island that represents one of them stays regardless of its size.
pub(super) fn mend_all(
    grid: &Grid,
    labels: &mut Labels,
    walls: &Walls,
    parts: &[ClosedParts],
) -> Mending {
    let mut mending = Mending::default();
    for _ in 0..ROUNDS {
        let given = walls.put_layers_back(grid, labels);
        mend(grid, labels, walls, &mut mending);
        if given == 0 {
            break;
        }
    }
    for _ in 0..ROUNDS {
        let bridges = bridge::build_bridges(grid, labels, walls);
        if bridges == 0 {
            break;
        }
        mend(grid, labels, walls, &mut mending);
    }
    for _ in 0..ROUNDS {
        let before = mending.dropped.0;
        drop_islands(grid, labels, parts, &mut mending);
        if mending.dropped.0 == before {
            break;
        }
        mend(grid, labels, walls, &mut mending);
    }
    drop_crumbs(grid, labels, &mut mending);
    mending
}

/// Whether the set bits of a 2x2x2 block are connected through faces (an empty block counts as connected).
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

/// Number of labels in a block whose surface is not a manifold there.
fn faults(block: [u8; 8], table: &[bool; 256]) -> usize {
    let mut seen = 0_u8;
    let mut faults = 0;
    for c in 0..8 {
        if seen >> c & 1 == 1 {
            continue;
        }
        let mask = (0..8).fold(0_u8, |m, d| m | u8::from(block[d] == block[c]) << d);
        seen |= mask;
        faults += usize::from(!table[mask as usize]);
    }
    faults
}

/// Flips the most doubtful cells until the surface of the model and of every region is a manifold. Where two
/// cells touch along an edge or at a corner only, a surface could not be wound consistently, and one node would
/// need two positions.
fn mend(grid: &Grid, labels: &mut Labels, walls: &Walls, mending: &mut Mending) {
    let table: [bool; 256] = std::array::from_fn(|block| manifold(block as u8));
    let mut found: Vec<[usize; 3]> = (0..grid.cells[2] - 1)
        .into_par_iter()
        .flat_map_iter(|k| faulty_blocks(grid, labels, k, &table))
        .collect();
    for pass in 0.. {
        let mut flipped = Vec::new();
        for &at in &found {
            let cells = block_cells(grid, at);
            let block = cells.map(|c| labels.label[c]);
            // An earlier flip of this pass may have repaired it.
            if faults(block, &table) > 0
                && let Some((c, to)) =
                    best_flip(grid, labels, walls, &cells, pass < TWO_WAY_PASSES, &table)
            {
                let cell = cells[c];
                if to == 0 || block[c] == 0 {
                    mending.flipped_outer += 1;
                } else {
                    mending.flipped_inner += 1;
                }
                labels.second[cell] = labels.label[cell];
                labels.label[cell] = to;
                labels.held.remove(&cell);
                // Once flipped, a cell is not the first choice for the way back.
                labels.margin[cell] = 128;
                flipped.push(cell);
            }
        }
        if flipped.is_empty() {
            break;
        }
        // No other block has changed.
        found.extend(flipped.iter().flat_map(|&cell| blocks_of(grid, cell)));
        found.sort_unstable_by_key(|at| [at[2], at[1], at[0]]);
        found.dedup();
        found.retain(|&at| faults(block_cells(grid, at).map(|c| labels.label[c]), &table) > 0);
    }
}

fn blocks_of(grid: &Grid, cell: usize) -> impl Iterator<Item = [usize; 3]> + use<> {
    let (at, count) = (cell_at(grid, cell), grid.cells);
    let corner = move |c: usize| {
        let below = |a: usize| at[a].checked_sub(c >> a & 1).filter(|i| i + 1 < count[a]);
        Some([below(0)?, below(1)?, below(2)?])
    };
    (0..8).filter_map(corner)
}

/// The blocks between cell layers `k` and `k + 1` that have a fault.
fn faulty_blocks(grid: &Grid, labels: &Labels, k: usize, table: &[bool; 256]) -> Vec<[usize; 3]> {
    let mut found = Vec::new();
    for j in 0..grid.cells[1] - 1 {
        for i in 0..grid.cells[0] - 1 {
            let block = block_cells(grid, [i, j, k]).map(|c| labels.label[c]);
            if block.iter().any(|&l| l != block[0]) && faults(block, table) > 0 {
                found.push([i, j, k]);
            }
        }
    }
    found
}

/// The eight cells around grid point `at + 1`.
fn block_cells(grid: &Grid, at: [usize; 3]) -> [usize; 8] {
    std::array::from_fn(|c| {
        grid.cell_index([at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2 & 1)])
    })
}

/// The cell of a block to flip and its new label. Candidates are ordered by: fewest faults left here, cell
/// connects nothing, fewest new faults in the blocks around, fewest new false faces, least confident label.
/// Faults that move on from block to block end in cells that a region fills. With `any` false a label may only
/// decrease, which cannot cycle.
fn best_flip(
    grid: &Grid,
    labels: &Labels,
    walls: &Walls,
    cells: &[usize; 8],
    any: bool,
    table: &[bool; 256],
) -> Option<(usize, u8)> {
    let block = cells.map(|c| labels.label[c]);
    // Faults left, whether it connects a region, faults made around, false faces, doubt, and the flip itself as
    // the tie-break.
    let mut best: Option<(usize, bool, usize, i32, u16, usize, u8)> = None;
    for c in 0..8 {
        // The margin of the grid stays empty.
        let at = cell_at(grid, cells[c]);
        if (0..3).any(|a| at[a] == 0 || at[a] + 1 == grid.cells[a]) {
            continue;
        }
        let held = labels.held.contains(&cells[c]);
        for to in block {
            if to == block[c] || !(any || to < block[c]) {
                continue;
            }
            let mut after = block;
            after[c] = to;
            let here = faults(after, table);
            // The blocks around are more expensive to check.
            if best.is_some_and(|b| (b.0, b.1) < (here, held)) {
                continue;
            }
            let made = faults_made(grid, labels, cells[c], to, table);
            let unlikely = if to == labels.second[cells[c]] {
                0
            } else {
                256
            };
            let doubt = u16::from(labels.margin[cells[c]]) + unlikely;
            let parted = walls.false_faces_won(grid, labels, cells[c], to);
            let key = (here, held, made, parted, doubt, c, to);
            if best.is_none_or(|b| key < b) {
                best = Some(key);
            }
        }
    }
    best.map(|(_, _, _, _, _, c, to)| (c, to))
}

/// Faults that another label in a cell makes in the blocks around it, not counting those that it repairs.
fn faults_made(grid: &Grid, labels: &Labels, cell: usize, to: u8, table: &[bool; 256]) -> usize {
    let made = |at| {
        let cells = block_cells(grid, at);
        let before = cells.map(|c| labels.label[c]);
        let after = cells.map(|c| if c == cell { to } else { labels.label[c] });
        faults(after, table).saturating_sub(faults(before, table))
    };
    blocks_of(grid, cell).map(made).sum()
}

/// Pieces of face-connected cells: the piece of each cell, from 1, and the size of each. Cells are connected
/// when `same` is true for their labels; label 0 is in no piece.
pub(super) fn pieces(
    grid: &Grid,
    labels: &Labels,
    same: impl Fn(u8, u8) -> bool,
) -> (Vec<u32>, Vec<usize>) {
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
                let label = labels.label[other];
                if label != 0 && piece_of[other] == 0 && same(labels.label[cell], label) {
                    piece_of[other] = piece;
                    stack.push(other);
                }
            }
        }
    }
    (piece_of, sizes)
}

/// Gives islands of a region that are too small to be intended to the surrounding regions.
fn drop_islands(grid: &Grid, labels: &mut Labels, parts: &[ClosedParts], mending: &mut Mending) {
    let (piece_of, sizes) = pieces(grid, labels, |a, b| a == b);
    let mut label_of = vec![0_u8; sizes.len()];
    for (cell, &piece) in piece_of.iter().enumerate() {
        label_of[piece as usize] = labels.label[cell];
    }
    let mut largest = [0_usize; 256];
    for (&label, &size) in label_of.iter().zip(&sizes) {
        largest[label as usize] = largest[label as usize].max(size);
    }
    let small = |piece: u32| {
        let largest = largest[label_of[piece as usize] as usize];
        let least = ISLAND_MIN.max((largest as f64 * ISLAND_PART).ceil() as usize);
        // The largest piece of a region stays regardless of its size.
        piece != 0 && sizes[piece as usize] < least.min(largest)
    };
    let mut dropped: BTreeMap<u32, Dropped> = BTreeMap::new();
    for (cell, &piece) in piece_of.iter().enumerate().filter(|(_, p)| small(**p)) {
        let entry = dropped.entry(piece).or_default();
        entry.cells.push(cell);
        for other in face_neighbours(grid, cell).into_iter().flatten() {
            if piece_of[other] != piece {
                *entry.around.entry(labels.label[other]).or_default() += 1;
            }
        }
    }
    for (piece, Dropped { cells, around }) in dropped {
        let label = label_of[piece as usize];
        if stands_for_a_part(grid, &cells, &parts[label as usize - 1].boxes) {
            continue;
        }
        let commonest = around
            .iter()
            .max_by_key(|(label, count)| (**count, 255 - **label));
        let given = commonest.map_or(0, |(label, _)| *label);
        for &cell in &cells {
            labels.label[cell] = given;
            labels.margin[cell] = 255;
        }
        mending.record(grid, label, given, &cells);
    }
}

/// Whether one of the parts lies within a cell of these cells.
fn stands_for_a_part(grid: &Grid, cells: &[usize], parts: &[Aabb]) -> bool {
    let at = || {
        cells
            .iter()
            .map(|&c| Vec3::from(cell_at(grid, c).map(|i| i as f64)))
    };
    let low = at()
        .fold(Vec3::repeat(f64::INFINITY), |m, p| m.inf(&p))
        .add_scalar(-1.0);
    let high = at()
        .fold(Vec3::repeat(f64::NEG_INFINITY), |m, p| m.sup(&p))
        .add_scalar(2.0);
    let within = Aabb {
        min: grid.origin + low * grid.spacing,
        max: grid.origin + high * grid.spacing,
    };
    parts
        .iter()
        .any(|part| within.contains(&part.min) && within.contains(&part.max))
}

/// The cells of an island and the number of faces with each label beside it.
#[derive(Default)]
struct Dropped {
    cells: Vec<usize>,
    around: BTreeMap<u8, usize>,
}

impl Mending {
    fn record(&mut self, grid: &Grid, label: u8, given: u8, cells: &[usize]) {
        self.dropped.0 += 1;
        self.dropped.1 += cells.len();
        if self.crumbs.len() < PLACES_MAX {
            self.crumbs.push(Crumb {
                label,
                given,
                cells: cells.iter().map(|&c| cell_at(grid, c)).collect(),
            });
        }
    }
}

/// Drops pieces of the whole model that are too small to be intended.
fn drop_crumbs(grid: &Grid, labels: &mut Labels, mending: &mut Mending) {
    let (piece_of, sizes) = pieces(grid, labels, |_, _| true);
    let least = (sizes.iter().copied().max().unwrap_or(0) as f64 * PIECE_MIN).ceil() as usize;
    let small = |piece: u32| piece != 0 && sizes[piece as usize] < least;
    let mut dropped: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (cell, &piece) in piece_of.iter().enumerate().filter(|(_, p)| small(**p)) {
        dropped.entry(piece).or_default().push(cell);
    }
    for cells in dropped.into_values() {
        let label = labels.label[cells[0]];
        for &cell in &cells {
            labels.label[cell] = 0;
        }
        mending.record(grid, label, 0, &cells);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Surface;
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    #[test]
    fn cells_sharing_only_an_edge_or_corner_are_not_manifold() {
        assert!(manifold(0b1111_1111) && manifold(0) && manifold(0b0000_0001));
        assert!(manifold(0b0000_0011));
        assert!(!manifold(0b0000_1001));
        assert!(!manifold(0b1000_0001));
        assert!(!manifold(!0b1000_0001));
    }

    #[test]
    fn flip_that_only_moves_a_fault_is_rejected() {
        let grid = Grid {
            origin: Vec3::zeros(),
            spacing: 1.0,
            cells: [7, 7, 7],
        };
        let empty = || vec![0; grid.cell_count()];
        let mut labels = Labels {
            label: empty(),
            second: vec![1; grid.cell_count()],
            margin: vec![200; grid.cell_count()],
            held: BTreeSet::new(),
        };
        // The first two touch along an edge only. When the more doubtful cell beside them is filled, the third
        // one does so too.
        for at in [[2, 2, 3], [3, 3, 3], [1, 4, 3]] {
            labels.label[grid.cell_index(at)] = 1;
        }
        let [worse, better] = [[2, 3, 3], [3, 2, 3]].map(|at| grid.cell_index(at));
        labels.margin[worse] = 10;
        labels.margin[better] = 20;
        let mut after = labels.label.clone();
        after[better] = 1;
        let mut mending = Mending::default();
        mend(&grid, &mut labels, &Walls::default(), &mut mending);
        assert_eq!(labels.label, after);
        assert_eq!(mending.flipped_outer, 1);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn repair_makes_every_label_surface_a_manifold(
            cells in prop::collection::vec((0..4_u8, 0..4_u8, any::<u8>()), 512),
        ) {
            let grid = Grid { origin: Vec3::zeros(), spacing: 1.0, cells: [10, 10, 10] };
            let empty = || vec![0; 1000];
            let mut labels = Labels { label: empty(), second: empty(), margin: empty(), held: BTreeSet::new() };
            for (n, &(label, second, margin)) in cells.iter().enumerate() {
                let cell = grid.cell_index([1 + n % 8, 1 + n / 8 % 8, 1 + n / 64]);
                labels.label[cell] = label;
                labels.second[cell] = second;
                labels.margin[cell] = margin;
            }
            let parts = [(); 3].map(|()| ClosedParts::of(&Surface::default()));
            mend_all(&grid, &mut labels, &Walls::default(), &parts);
            let table: [bool; 256] = std::array::from_fn(|block| manifold(block as u8));
            for at in 0..9 * 9 * 9 {
                let cells = block_cells(&grid, [at % 9, at / 9 % 9, at / 81]);
                prop_assert_eq!(faults(cells.map(|c| labels.label[c]), &table), 0);
            }
        }
    }
}
