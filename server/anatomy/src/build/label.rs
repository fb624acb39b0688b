//! The region of each cell of the grid, and the exact volumes of the input.
//!
//! Sixteen rays run along z through every column of cells. The stretches of each ray inside each surface, with
//! overlaps resolved in favour of the later region, give the fraction of every cell that each region fills. A
//! cell belongs to the model when at least half of it is inside. It then gets the region that fills most of it.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::folds::Folds;
use super::gaps::{Parts, Run};
use super::grid::Grid;
use super::overlap::InputRays;
use super::rays::{Hits, Rays, cast};
use super::strands::{NOTHING, RAYS_PER_CELL, Strand, Strands};
use super::walls::{Share, Walls, contact};
use crate::Surface;

/// A cell is homogeneous when one region fills all but this part of it.
const PURE: f64 = 1e-3;
/// Labels of the cells of the grid.
#[derive(Debug)]
pub(super) struct Labels {
    /// Region number plus one for each cell, 0 outside the model.
    pub(super) label: Vec<u8>,
    /// The label with the second largest fraction.
    pub(super) second: Vec<u8>,
    /// Lead of the first label over the second, in 1/255 of the cell.
    pub(super) margin: Vec<u8>,
    /// Cells given to a region because they connect it.
    pub(super) held: BTreeSet<usize>,
}

impl Labels {
    /// Gives a cell to a region that it connects; it is the last candidate for another flip.
    pub(super) fn fix_label(&mut self, cell: usize, label: u8) {
        self.second[cell] = self.label[cell];
        self.label[cell] = label;
        self.held.insert(cell);
    }
}

/// Label, second label and margin of one cell.
type Decision = [u8; 3];

/// Classifies every cell of the grid, and passes the fills of inhomogeneous cells to `walls`. Also returns the parts
/// of the regions.
pub(super) fn label(grid: &Grid, surfaces: &[&Surface], walls: &mut Walls) -> (Labels, Parts) {
    let [nx, ny, nz] = grid.cells;
    let strands = Strands::new(grid, surfaces);
    // One slab of constant y at a time; slabs are independent.
    let slabs: Vec<(Vec<Decision>, Vec<Share>, Vec<Run>)> = (0..ny)
        .into_par_iter()
        .map(|j| {
            let mut decisions = vec![[0; 3]; nx * nz];
            let (mut shares, mut runs) = (Vec::new(), Vec::new());
            let mut column = Column::new(nz, surfaces.len());
            for i in 0..nx {
                column.fill(&strands, [i, j]);
                for k in 0..nz {
                    decisions[i + nx * k] = decide(column.part(k));
                }
                column.runs(i + nx * j, &mut runs);
                column.shares(grid, [i, j], &mut shares);
            }
            (decisions, shares, runs)
        })
        .collect();
    let mut labels = Labels {
        label: vec![0; grid.cell_count()],
        second: vec![0; grid.cell_count()],
        margin: vec![0; grid.cell_count()],
        held: BTreeSet::new(),
    };
    let mut parts = Parts::new(strands.touching());
    for (j, (decisions, shares, runs)) in slabs.into_iter().enumerate() {
        for (at, decision) in decisions.into_iter().enumerate() {
            let to = grid.cell_index([at % nx, j, at / nx]);
            [labels.label[to], labels.second[to], labels.margin[to]] = decision;
        }
        walls.add_shares(shares);
        parts.add_runs(runs);
    }
    walls.sort();
    (labels, parts)
}

/// Fills of the cells of one column along z.
struct Column {
    regions: usize,
    /// Summed lengths of rays in each region, for each cell.
    lengths: Vec<f64>,
    /// Cell, label, part of the region, and length of a ray in it.
    pieces: Vec<(u32, u8, u32, f64)>,
}

impl Column {
    fn new(cells: usize, regions: usize) -> Self {
        Self {
            regions,
            lengths: vec![0.0; cells * regions],
            pieces: Vec::new(),
        }
    }

    /// Lengths of rays in each region within cell `k`.
    fn part(&self, k: usize) -> &[f64] {
        &self.lengths[k * self.regions..(k + 1) * self.regions]
    }

    fn fill(&mut self, strands: &Strands, at: [usize; 2]) {
        self.lengths.fill(0.0);
        self.pieces.clear();
        for sub in 0..RAYS_PER_CELL * RAYS_PER_CELL {
            let ray = [sub % RAYS_PER_CELL, sub / RAYS_PER_CELL];
            let ray = [0, 1].map(|a| at[a] * RAYS_PER_CELL + ray[a]);
            for (strand, part) in strands.of(ray) {
                self.spread(strand, part);
            }
        }
    }

    /// Adds a strand to the cells that it passes.
    fn spread(&mut self, strand: &Strand, part: u32) {
        let region = usize::from(strand.region);
        let mut k = strand.from.floor().max(0.0) as usize;
        let mut at = strand.from;
        while at < strand.to && k * self.regions < self.lengths.len() {
            let next = strand.to.min((k + 1) as f64);
            self.lengths[k * self.regions + region] += next - at;
            self.pieces
                .push((k as u32, strand.region + 1, part, next - at));
            at = next;
            k += 1;
        }
    }

    /// Whether one region fills cell `k` alone.
    fn is_pure(&self, k: usize) -> bool {
        let full = (RAYS_PER_CELL * RAYS_PER_CELL) as f64;
        self.part(k).iter().any(|l| *l >= full * (1.0 - PURE))
    }

    /// Lists the parts that fill cells alone, each with the first cell of a run.
    fn runs(&self, column: usize, runs: &mut Vec<Run>) {
        // One ray passes all of these cells.
        let mut last: Option<(u32, u32)> = None;
        let sole = self.pieces.iter();
        let sole = sole.filter(|p| p.3 > 0.5 && self.is_pure(p.0 as usize));
        for &(k, label, part, _) in sole {
            if last.is_some_and(|(before, ..)| k <= before) {
                break;
            }
            if last.is_none_or(|(_, of)| of != part) {
                runs.push(Run {
                    column: column as u32,
                    from: k,
                    label,
                    part,
                });
            }
            last = Some((k, part));
        }
    }

    /// Lists the fills of each cell that is not filled by one region alone.
    fn shares(&mut self, grid: &Grid, [i, j]: [usize; 2], shares: &mut Vec<Share>) {
        let full = (RAYS_PER_CELL * RAYS_PER_CELL) as f64;
        let mut pieces = std::mem::take(&mut self.pieces);
        pieces.retain(|p| !self.is_pure(p.0 as usize));
        pieces.sort_by_key(|p| (p.0, p.1, p.2));
        for same in pieces.chunk_by(|a, b| (a.0, a.1, a.2) == (b.0, b.1, b.2)) {
            let (k, label, part, _) = same[0];
            let length: f64 = same.iter().map(|p| p.3).sum();
            let cell = grid.cell_index([i, j, k as usize]);
            shares.push(Share::new(cell, label, part, length / full));
        }
        self.pieces = pieces;
    }
}

/// Decides a cell from the summed lengths of its rays in each region.
fn decide(part: &[f64]) -> Decision {
    let full = (RAYS_PER_CELL * RAYS_PER_CELL) as f64;
    let inside: f64 = part.iter().sum();
    let mut best = 0;
    for (region, &length) in part.iter().enumerate() {
        // At equal parts the later region gets the cell, as where surfaces overlap.
        if length >= part[best] {
            best = region;
        }
    }
    let margin = |ahead: f64| (ahead / full * 255.0).round().clamp(0.0, 255.0) as u8;
    let first = best as u8 + 1;
    if inside < full / 2.0 {
        let second = if inside > 0.0 { first } else { 0 };
        return [0, second, margin(full - 2.0 * inside)];
    }
    let mut second = (0, 2.0 * inside - full);
    for (region, &length) in part.iter().enumerate() {
        if region != best && length > 0.0 && part[best] - length < second.1 {
            second = (region as u8 + 1, part[best] - length);
        }
    }
    [first, second.0, margin(second.1)]
}

/// Volume in m³ of each region with overlaps resolved, and the folds of surfaces that have some.
///
/// The volume of each whole surface is exact (divergence theorem) unless it is folded. `rays` give the part that no later
/// region takes, measured as a ratio to the same rays' measure of the whole, so that the sampling error of flat ends
/// and rims cancels. Rays of three directions along the lattice give `walls` the regions that touch and where.
pub(super) fn resolved_volumes(
    grid: &Grid,
    surfaces: &[&Surface],
    rays: &InputRays,
    walls: &mut Walls,
) -> (Vec<f64>, Vec<(usize, Folds)>) {
    let folded = (0..3).fold(0_u64, |folded, axis| {
        folded | contacts_along(grid, surfaces, axis, walls)
    });
    let folds: Vec<(usize, Folds)> = (0..surfaces.len())
        .filter(|r| folded >> r & 1 == 1)
        .map(|r| (r, Folds::measure(surfaces[r], grid.spacing)))
        .collect();
    let volume = |r: usize| {
        let own = folds.iter().find(|f| f.0 == r);
        own.map_or_else(|| surfaces[r].volume(), |(_, folds)| folds.volume)
    };
    let volumes = (0..surfaces.len()).map(|r| volume(r) * rays.kept(r));
    (volumes.collect(), folds)
}

/// Adds the contacts of regions along the rays of one axis to `walls`. Returns the set of regions in which some ray finds
/// another winding number than one.
fn contacts_along(grid: &Grid, surfaces: &[&Surface], axis: usize, walls: &mut Walls) -> u64 {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let step = grid.spacing / 2.0;
    let rays = Rays {
        axis,
        first: [grid.origin[u] + step / 2.0, grid.origin[v] + step / 2.0],
        step,
        count: [2 * grid.cells[u], 2 * grid.cells[v]],
    };
    let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
    let rows: Vec<Row> = (0..rays.count[1])
        .into_par_iter()
        .map(|row| {
            let mut found = Row::default();
            let mut sweep = Sweep::default();
            for column in 0..rays.count[0] {
                let ray = rays.index([column, row]);
                for (region, hits) in hits.iter().enumerate() {
                    let mut once = true;
                    let cancel = hits.windings(ray, |_, _, winding| once &= winding == 1);
                    found.folded |= u64::from(!(once && cancel)) << region;
                }
                let mut marks = Marks::new(grid, axis, [column / 2, row / 2]);
                sweep.resolve(&hits, ray, |region, from, to| {
                    marks.pass(region, from, to, &mut found.contacts);
                });
                marks.leave(&mut found.contacts);
            }
            found.contacts.sort_unstable();
            found.contacts.dedup();
            found
        })
        .collect();
    let folded = rows.iter().fold(0, |folded, row| folded | row.folded);
    for row in rows {
        walls.add_contacts(row.contacts);
    }
    folded
}

/// Findings of the rays of one row.
#[derive(Default)]
struct Row {
    /// See [`contact`].
    contacts: Vec<u64>,
    /// Bit `r`: the winding number in region `r` is not one everywhere.
    folded: u64,
}

/// Follows a ray from region to region and records the cells in which two of them touch.
struct Marks<'a> {
    grid: &'a Grid,
    axis: usize,
    /// The column of cells: indices along the next two axes.
    column: [usize; 2],
    /// The current label of the ray, and where the ray leaves it.
    last: (u8, f64),
}

impl<'a> Marks<'a> {
    fn new(grid: &'a Grid, axis: usize, column: [usize; 2]) -> Self {
        let last = (0, f64::NEG_INFINITY);
        Self {
            grid,
            axis,
            column,
            last,
        }
    }

    /// The ray passes through a stretch of a region.
    fn pass(&mut self, region: usize, from: f64, to: f64, contacts: &mut Vec<u64>) {
        let nothing = NOTHING * self.grid.spacing;
        if to - from < nothing {
            return;
        }
        let label = region as u8 + 1;
        if from - self.last.1 > nothing {
            self.leave(contacts);
            self.mark(0, label, from, contacts);
        } else if self.last.0 != label {
            self.mark(self.last.0, label, from, contacts);
        }
        self.last = (label, to);
    }

    /// The ray leaves its current region.
    fn leave(&self, contacts: &mut Vec<u64>) {
        if self.last.0 != 0 {
            self.mark(self.last.0, 0, self.last.1, contacts);
        }
    }

    fn mark(&self, a: u8, b: u8, depth: f64, contacts: &mut Vec<u64>) {
        let along = (depth - self.grid.origin[self.axis]) / self.grid.spacing;
        let mut at = [0; 3];
        at[self.axis] = (along.max(0.0) as usize).min(self.grid.cells[self.axis] - 1);
        at[(self.axis + 1) % 3] = self.column[0];
        at[(self.axis + 2) % 3] = self.column[1];
        contacts.push(contact(self.grid.cell_index(at), a, b));
    }
}

/// Resolves the overlaps of all surfaces along one ray; owns the buffers for it.
#[derive(Debug, Default)]
pub(super) struct Sweep {
    /// Where a region begins (+) or ends (-).
    turns: Vec<(f64, usize, bool)>,
}

impl Sweep {
    /// Calls `each` with (region, from, to) for every stretch, the later region winning.
    pub(super) fn resolve(
        &mut self,
        hits: &[Hits],
        ray: usize,
        mut each: impl FnMut(usize, f64, f64),
    ) {
        self.turns.clear();
        for (region, hits) in hits.iter().enumerate() {
            hits.inside(ray, |from, to| {
                self.turns.push((from, region, true));
                self.turns.push((to, region, false));
            });
        }
        self.turns.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut inside = 0_u64;
        let mut from = 0.0;
        for &(at, region, enters) in &self.turns {
            if inside != 0 && at > from {
                each(63 - inside.leading_zeros() as usize, from, at);
            }
            from = at;
            if enters {
                inside |= 1 << region;
            } else {
                inside &= !(1 << region);
            }
        }
    }
}
