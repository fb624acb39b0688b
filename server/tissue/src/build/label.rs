//! Which region fills each cell of the grid, and the exact volumes of the input.
//!
//! Sixteen rays run along z through every column of cells; the stretches of each ray inside each
//! surface, with overlaps resolved in favour of the later region, give the part of every cell that
//! each region fills. A cell belongs to the model when at least half of it is inside, and then to
//! the region that fills most of it.

use rayon::prelude::*;

use super::grid::Grid;
use super::rays::{Hits, Rays, cast};
use crate::Surface;

/// Rays across a cell along x and along y.
const RAYS_PER_CELL: usize = 4;

/// What fills the cells of the grid.
#[derive(Debug)]
pub(super) struct Labels {
    /// Region number plus one for each cell, 0 outside the model.
    pub(super) label: Vec<u8>,
    /// The label that came second.
    pub(super) second: Vec<u8>,
    /// By how much of the cell the first one was ahead, in 1/255.
    pub(super) margin: Vec<u8>,
}

/// Label, second label and margin of one cell.
type Decision = [u8; 3];

/// Classifies every cell of the grid.
pub(super) fn label(grid: &Grid, surfaces: &[&Surface]) -> Labels {
    let [nx, ny, nz] = grid.cells;
    let step = grid.spacing / RAYS_PER_CELL as f64;
    let rays = Rays {
        axis: 2,
        first: [grid.origin.x + step / 2.0, grid.origin.y + step / 2.0],
        step,
        count: [nx * RAYS_PER_CELL, ny * RAYS_PER_CELL],
    };
    let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
    let regions = surfaces.len();
    // One slab of constant y at a time; slabs are independent.
    let slabs: Vec<Vec<Decision>> = (0..ny)
        .into_par_iter()
        .map(|j| {
            let mut decisions = vec![[0; 3]; nx * nz];
            let mut part = vec![0.0; nz * regions];
            let mut sweep = Sweep::default();
            for i in 0..nx {
                part.fill(0.0);
                for sub in 0..RAYS_PER_CELL * RAYS_PER_CELL {
                    let u = i * RAYS_PER_CELL + sub % RAYS_PER_CELL;
                    let v = j * RAYS_PER_CELL + sub / RAYS_PER_CELL;
                    sweep.resolve(&hits, rays.index([u, v]), |region, from, to| {
                        let at = |z: f64| (z - grid.origin.z) / grid.spacing;
                        spread(&mut part, regions, region, at(from), at(to));
                    });
                }
                for k in 0..nz {
                    decisions[i + nx * k] = decide(&part[k * regions..(k + 1) * regions]);
                }
            }
            decisions
        })
        .collect();
    let mut labels = Labels {
        label: vec![0; grid.cell_count()],
        second: vec![0; grid.cell_count()],
        margin: vec![0; grid.cell_count()],
    };
    for (j, decisions) in slabs.iter().enumerate() {
        for (at, decision) in decisions.iter().enumerate() {
            let to = grid.cell_index([at % nx, j, at / nx]);
            [labels.label[to], labels.second[to], labels.margin[to]] = *decision;
        }
    }
    labels
}

/// Adds the stretch `from..to`, in cells along z, to what its region fills.
fn spread(part: &mut [f64], regions: usize, region: usize, from: f64, to: f64) {
    let mut k = from.floor().max(0.0) as usize;
    let mut at = from;
    while at < to && k * regions < part.len() {
        let next = to.min((k + 1) as f64);
        part[k * regions + region] += next - at;
        at = next;
        k += 1;
    }
}

/// Decides a cell from the summed lengths of its rays in each region.
fn decide(part: &[f64]) -> Decision {
    let full = (RAYS_PER_CELL * RAYS_PER_CELL) as f64;
    let inside: f64 = part.iter().sum();
    let mut best = 0;
    for (region, &length) in part.iter().enumerate() {
        // At equal parts the later region has the cell, as where surfaces overlap.
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

/// Volume in m³ of each region with overlaps resolved.
///
/// The volume of each whole surface is exact (divergence theorem). What part of it later regions
/// take is measured along rays of all three directions; as a ratio to the same rays' measure of the
/// whole, so that the error of sampling flat ends and rims cancels.
pub(super) fn resolved_volumes(grid: &Grid, surfaces: &[&Surface]) -> Vec<f64> {
    let kept: Vec<Vec<f64>> = (0..3)
        .map(|axis| kept_along(grid, surfaces, axis))
        .collect();
    surfaces
        .iter()
        .enumerate()
        .map(|(r, surface)| surface.volume() * kept.iter().map(|k| k[r]).sum::<f64>() / 3.0)
        .collect()
}

/// Part of each region's rays along one axis that no later region takes.
fn kept_along(grid: &Grid, surfaces: &[&Surface], axis: usize) -> Vec<f64> {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let step = grid.spacing / 2.0;
    let rays = Rays {
        axis,
        first: [grid.origin[u] + step / 2.0, grid.origin[v] + step / 2.0],
        step,
        count: [2 * grid.cells[u], 2 * grid.cells[v]],
    };
    let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
    // Row by row, and the rows summed in order: the same sum on any number of threads.
    let rows: Vec<Vec<[f64; 2]>> = (0..rays.count[1])
        .into_par_iter()
        .map(|row| {
            let mut sums = vec![[0.0; 2]; surfaces.len()];
            let mut sweep = Sweep::default();
            for column in 0..rays.count[0] {
                let ray = rays.index([column, row]);
                for (region, hits) in hits.iter().enumerate() {
                    hits.inside(ray, |from, to| sums[region][0] += to - from);
                }
                sweep.resolve(&hits, ray, |region, from, to| sums[region][1] += to - from);
            }
            sums
        })
        .collect();
    (0..surfaces.len())
        .map(|r| {
            let sum = |which: usize| rows.iter().map(|row| row[r][which]).sum::<f64>();
            let whole = sum(0);
            if whole > 0.0 { sum(1) / whole } else { 1.0 }
        })
        .collect()
}

/// Resolves the overlaps of all surfaces along one ray; holds the memory for it.
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
