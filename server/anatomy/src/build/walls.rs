//! Keeping thin layers between the regions that they separate (reconstructed).
//!
//! A layer of about half a spacing rarely fills most of a cell. Where it runs oblique to the lattice, its cells
//! become disconnected, and the regions on its two sides touch although they never do in the input. Such a
//! *false* face is repaired by giving the layer one of the face's two cells. Its nodes are put onto the layer's
//! two interfaces afterwards, which restores the true thickness. Where the two regions meet in an edge only, its nodes
//! could lie on one interface only, and the layer would have no thickness there; so it gets one of the two cells, too.
//!
//! Rays in three directions detect whether two regions touch in a cell.

use rayon::prelude::*;

use super::grid::Grid;
use super::label::Labels;
use super::lattice::{cell_at, face_neighbours};

/// Least thickness of a layer that is restored, in spacings along an axis of the lattice, as a mean over nine
/// adjacent lines. Springs across a thinner layer would be shorter than the floor.
const LAYER_MIN: f64 = 0.2;
/// The same for the one line through the face. Real layers are pinched here and there: labels of one voxel that
/// meet in an edge only have zero thickness there.
const LINE_MIN: f64 = 0.05;

/// Least part of a cell that a region fills where it counts as lost when no cell around represents it: a few
/// rays of sixteen.
const LOST_MIN: f64 = 0.1;

/// Rounds of the search for false faces. Repairing one may reveal another; each round leaves fewer.
const ROUNDS: usize = 8;

/// The labels that touch in each cell, and the fraction of each cell that every label fills. Without rays (the
/// default) nothing is known, and every face counts as true.
#[derive(Debug, Default)]
pub(super) struct Walls {
    /// See [`contact`]; sorted.
    contacts: Vec<u64>,
    /// Sorted. Cells filled by one label are not in it.
    shares: Vec<Share>,
}

/// Fill of a cell by a part of a region.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Share {
    cell: u32,
    pub(super) label: u8,
    /// Number of the part of the region; parts do not touch each other.
    pub(super) part: u32,
    /// In 1/255 of the cell.
    filled: u8,
}

impl Share {
    pub(super) fn new(cell: usize, label: u8, part: u32, filled: f64) -> Self {
        let filled = (filled * 255.0).round().clamp(0.0, 255.0) as u8;
        Self {
            cell: cell as u32,
            label,
            part,
            filled,
        }
    }

    /// The filled part of the cell.
    pub(super) fn filled(&self) -> f64 {
        f64::from(self.filled) / 255.0
    }
}

/// Two labels that touch in a cell.
pub(super) fn contact(cell: usize, a: u8, b: u8) -> u64 {
    (cell as u64) << 16 | u64::from(a.min(b)) << 8 | u64::from(a.max(b))
}

impl Walls {
    pub(super) fn add_contacts(&mut self, mut contacts: Vec<u64>) {
        self.contacts.append(&mut contacts);
    }

    pub(super) fn add_shares(&mut self, mut shares: Vec<Share>) {
        self.shares.append(&mut shares);
    }

    /// Sorts the entries; queries are allowed afterwards only.
    pub(super) fn sort(&mut self) {
        self.contacts.par_sort_unstable();
        self.contacts.dedup();
        self.shares.par_sort_unstable();
    }

    /// Cells that a region fills in part while neither they nor any cell that shares a face or an edge with
    /// them represents it: cell, its label, and the lost label.
    pub(super) fn lost(&self, grid: &Grid, labels: &Labels) -> Vec<(usize, u8, u8)> {
        let [nx, ny, nz] = grid.cells;
        let found = self.shares.par_iter().filter_map(|share| {
            let cell = share.cell as usize;
            let at = [cell % nx, cell / nx % ny, cell / (nx * ny)];
            let stands = |near: usize| {
                let step = [near % 3, near / 3 % 3, near / 9];
                let there: [usize; 3] = std::array::from_fn(|a| (at[a] + step[a]).wrapping_sub(1));
                let corner = step.iter().all(|s| *s != 1);
                let within = there[0] < nx && there[1] < ny && there[2] < nz;
                !corner && within && labels.label[grid.cell_index(there)] == share.label
            };
            let kept = share.filled() < LOST_MIN || (0..27).any(stands);
            (!kept).then_some((cell, labels.label[cell], share.label))
        });
        found.collect()
    }

    /// Part of a cell that a label fills.
    fn share(&self, labels: &Labels, cell: usize, label: u8) -> f64 {
        let own = self.shares_of(cell);
        if own.is_empty() {
            return f64::from(u8::from(labels.label[cell] == label));
        }
        let own = own.iter().filter(|s| s.label == label);
        own.map(Share::filled).sum()
    }

    /// The fills of a cell; empty when one label fills it all.
    pub(super) fn shares_of(&self, cell: usize) -> &[Share] {
        let cell = cell as u32;
        let from = self.shares.partition_point(|s| s.cell < cell);
        let count = self.shares[from..]
            .iter()
            .take_while(|s| s.cell == cell)
            .count();
        &self.shares[from..from + count]
    }

    /// The cells that no label fills alone, in order, each with its fills.
    pub(super) fn mixed(&self) -> impl ParallelIterator<Item = (usize, &[Share])> {
        let groups = self.shares.par_chunk_by(|a, b| a.cell == b.cell);
        groups.map(|own| (own[0].cell as usize, own))
    }

    /// The labels in mixed cells, each with its part.
    pub(super) fn parts(&self) -> impl Iterator<Item = (u8, u32)> {
        self.shares.iter().map(|s| (s.label, s.part))
    }

    fn touch(&self, cell: usize, a: u8, b: u8) -> bool {
        self.contacts.binary_search(&contact(cell, a, b)).is_ok()
    }

    /// Whether two cells with these labels would share a face where these never touch.
    fn is_false(&self, cells: [usize; 2], [a, b]: [u8; 2]) -> bool {
        a != b && !cells.iter().any(|cell| self.touch(*cell, a, b))
    }

    /// Additional false faces of a cell with label `to` instead of its own.
    pub(super) fn false_faces_won(&self, grid: &Grid, labels: &Labels, cell: usize, to: u8) -> i32 {
        if self.contacts.is_empty() {
            return 0;
        }
        let own = labels.label[cell];
        let with = |label: u8, other: usize| {
            i32::from(self.is_false([cell, other], [label, labels.label[other]]))
        };
        let others = face_neighbours(grid, cell).into_iter().flatten();
        others.map(|other| with(to, other) - with(own, other)).sum()
    }

    /// Gives layers the cells that are missing between the two regions that they separate.
    pub(super) fn put_layers_back(&self, grid: &Grid, labels: &mut Labels) -> usize {
        let mut given = 0;
        if self.contacts.is_empty() {
            return given;
        }
        for _ in 0..ROUNDS {
            let layers = (0..grid.cells[2] - 1).into_par_iter();
            let found: Vec<(usize, usize)> = layers
                .flat_map_iter(|k| self.false_faces(grid, labels, k))
                .collect();
            let before = given;
            for (cell, axis) in found {
                given += usize::from(self.cure(grid, labels, cell, axis));
            }
            let layers = (0..grid.cells[2] - 1).into_par_iter();
            let pinched: Vec<[usize; 4]> = layers
                .flat_map_iter(|k| self.pinched_edges(grid, labels, k))
                .collect();
            for cells in pinched {
                given += usize::from(self.widen(grid, labels, cells));
            }
            if given == before {
                break;
            }
        }
        given
    }

    /// The false faces above the cells of layer `k`: these cells, and the axis across each face.
    fn false_faces(&self, grid: &Grid, labels: &Labels, k: usize) -> Vec<(usize, usize)> {
        let steps = steps(grid);
        let mut found = Vec::new();
        for j in 0..grid.cells[1] - 1 {
            for i in 0..grid.cells[0] - 1 {
                let cell = grid.cell_index([i, j, k]);
                for (axis, step) in steps.into_iter().enumerate() {
                    let cells = [cell, cell + step];
                    if self.is_false(cells, cells.map(|c| labels.label[c])) {
                        found.push((cell, axis));
                    }
                }
            }
        }
        found
    }

    /// The edges of the cells of layer `k` at which two regions would meet that never touch: two cells across the edge
    /// from each other, and the other two.
    fn pinched_edges(&self, grid: &Grid, labels: &Labels, k: usize) -> Vec<[usize; 4]> {
        let steps = steps(grid);
        let mut found = Vec::new();
        for j in 0..grid.cells[1] - 1 {
            for i in 0..grid.cells[0] - 1 {
                let cell = grid.cell_index([i, j, k]);
                for [a, b] in [[0, 1], [1, 2], [2, 0]].map(|axes| axes.map(|a| steps[a])) {
                    let around = [cell, cell + a + b, cell + a, cell + b];
                    let turned = [around[2], around[3], around[0], around[1]];
                    let pinched = [around, turned].into_iter();
                    found.extend(pinched.filter(|cells| self.is_pinched(labels, *cells)));
                }
            }
        }
        found
    }

    /// Whether the first two of the cells around an edge belong to regions that touch in none of them.
    fn is_pinched(&self, labels: &Labels, cells: [usize; 4]) -> bool {
        let [a, b, c, d] = cells.map(|cell| labels.label[cell]);
        a != b
            && ![a, b].contains(&c)
            && ![a, b].contains(&d)
            && !cells.iter().any(|cell| self.touch(*cell, a, b))
    }

    /// Gives a layer that ends in an edge one of the two cells across this edge.
    fn widen(&self, grid: &Grid, labels: &mut Labels, cells: [usize; 4]) -> bool {
        if !self.is_pinched(labels, cells) {
            return false;
        }
        let mut best: Option<(f64, usize, u8)> = None;
        for layer in [cells[2], cells[3]].map(|c| labels.label[c]) {
            for taken in [cells[0], cells[1]] {
                let part = self.share(labels, taken, layer);
                let fits = part > 0.0
                    && !in_margin(grid, taken)
                    && self.false_faces_won(grid, labels, taken, layer) <= 0;
                if fits && best.as_ref().is_none_or(|b| part > b.0) {
                    best = Some((part, taken, layer));
                }
            }
        }
        let Some((_, taken, layer)) = best else {
            return false;
        };
        labels.fix_label(taken, layer);
        true
    }

    /// Repairs the face across `axis` above a cell if it is still false and a layer lies there.
    fn cure(&self, grid: &Grid, labels: &mut Labels, cell: usize, axis: usize) -> bool {
        let step = steps(grid)[axis];
        let cells = [cell, cell + step];
        let around = cells.map(|c| labels.label[c]);
        if !self.is_false(cells, around) {
            return false;
        }
        let mut best: Option<(i32, f64, usize, u8)> = None;
        for layer in cells
            .iter()
            .flat_map(|c| self.shares_of(*c))
            .map(|s| s.label)
        {
            if around.contains(&layer) || !self.is_thick_enough(grid, labels, cell, axis, layer) {
                continue;
            }
            // The margin of the grid stays empty.
            for taken in cells.into_iter().filter(|c| !in_margin(grid, *c)) {
                let won = self.false_faces_won(grid, labels, taken, layer);
                let part = self.share(labels, taken, layer);
                let better = |b: &(i32, f64, usize, u8)| won < b.0 || won == b.0 && part > b.1;
                if won < 0 && best.as_ref().is_none_or(better) {
                    best = Some((won, part, taken, layer));
                }
            }
        }
        let Some((_, _, taken, layer)) = best else {
            return false;
        };
        labels.fix_label(taken, layer);
        true
    }

    /// Whether the lattice can represent a layer across the face above `cell`.
    fn is_thick_enough(
        &self,
        grid: &Grid,
        labels: &Labels,
        cell: usize,
        axis: usize,
        layer: u8,
    ) -> bool {
        let at = cell_at(grid, cell);
        let thickness = |aside: [isize; 2], reach: isize| -> f64 {
            let cells = (1 - reach..=reach).filter_map(|along| {
                let mut to = at.map(|x| x as isize);
                to[axis] += along;
                to[(axis + 1) % 3] += aside[0];
                to[(axis + 2) % 3] += aside[1];
                let inside = (0..3).all(|a| to[a] >= 0 && to[a] < grid.cells[a] as isize);
                inside.then(|| grid.cell_index(to.map(|x| x as usize)))
            });
            cells.map(|c| self.share(labels, c, layer)).sum()
        };
        if thickness([0, 0], 2) < LINE_MIN {
            return false;
        }
        // An oblique layer has moved on by one cell beside it.
        let lines = (0..9).map(|n| thickness([n % 3 - 1, n / 3 - 1], 3));
        lines.sum::<f64>() >= 9.0 * LAYER_MIN
    }
}

/// Index offset of neighbouring cells along each axis.
fn steps(grid: &Grid) -> [usize; 3] {
    [1, grid.cells[0], grid.cells[0] * grid.cells[1]]
}

pub(super) fn in_margin(grid: &Grid, cell: usize) -> bool {
    let at = cell_at(grid, cell);
    (0..3).any(|a| at[a] == 0 || at[a] + 1 == grid.cells[a])
}
