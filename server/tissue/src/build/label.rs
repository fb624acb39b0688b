//! Which region fills each cell of the grid, and the exact volumes of the input.
//!
//! Sixteen rays run along z through every column of cells; the stretches of each ray inside each
//! surface, with overlaps resolved in favour of the later region, give the part of every cell that
//! each region fills. A cell belongs to the model when at least half of it is inside, and then to
//! the region that fills most of it.

use rayon::prelude::*;

use super::grid::Grid;
use super::rays::{Hits, Rays, cast};
use crate::{Surface, Vec3};

/// Rays across a cell along x and along y.
const RAYS_PER_CELL: usize = 4;

/// What fills the cells of the grid.
#[derive(Debug)]
pub(super) struct Labels {
    /// Region number plus one for each cell, 0 outside the model.
    pub(super) label: Vec<u8>,
    /// Part of each cell that is inside the model, in 1/255.
    pub(super) fill: Vec<u8>,
}

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
    let slabs: Vec<(Vec<u8>, Vec<u8>)> = (0..ny)
        .into_par_iter()
        .map(|j| {
            let mut labels = vec![0; nx * nz];
            let mut fills = vec![0; nx * nz];
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
                    let part = &part[k * regions..(k + 1) * regions];
                    let (label, fill) = decide(part);
                    labels[i + nx * k] = label;
                    fills[i + nx * k] = fill;
                }
            }
            (labels, fills)
        })
        .collect();
    let mut label = vec![0; grid.cell_count()];
    let mut fill = vec![0; grid.cell_count()];
    for (j, (labels, fills)) in slabs.iter().enumerate() {
        for k in 0..nz {
            let to = grid.cell_index([0, j, k]);
            label[to..to + nx].copy_from_slice(&labels[nx * k..nx * (k + 1)]);
            fill[to..to + nx].copy_from_slice(&fills[nx * k..nx * (k + 1)]);
        }
    }
    Labels { label, fill }
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

/// Label and fill of a cell from the summed lengths of its rays in each region.
fn decide(part: &[f64]) -> (u8, u8) {
    let full = (RAYS_PER_CELL * RAYS_PER_CELL) as f64;
    let inside: f64 = part.iter().sum();
    let fill = (inside / full * 255.0).round().clamp(0.0, 255.0) as u8;
    if inside < full / 2.0 {
        return (0, fill);
    }
    let mut best = 0;
    for (region, &length) in part.iter().enumerate() {
        // At equal parts the later region has the cell, as where surfaces overlap.
        if length >= part[best] {
            best = region;
        }
    }
    (best as u8 + 1, fill)
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
    let mut whole = vec![0.0; surfaces.len()];
    let mut kept = vec![0.0; surfaces.len()];
    let mut sweep = Sweep::default();
    for ray in 0..rays.count[0] * rays.count[1] {
        for (region, hits) in hits.iter().enumerate() {
            hits.inside(ray, |from, to| whole[region] += to - from);
        }
        sweep.resolve(&hits, ray, |region, from, to| kept[region] += to - from);
    }
    (0..surfaces.len())
        .map(|r| {
            if whole[r] > 0.0 {
                kept[r] / whole[r]
            } else {
                1.0
            }
        })
        .collect()
}

/// Resolves the overlaps of all surfaces along one ray; holds the memory for it.
#[derive(Debug, Default)]
struct Sweep {
    /// Where a region begins (+) or ends (-).
    turns: Vec<(f64, usize, bool)>,
}

impl Sweep {
    /// Calls `each` with (region, from, to) for every stretch, the later region winning.
    fn resolve(&mut self, hits: &[Hits], ray: usize, mut each: impl FnMut(usize, f64, f64)) {
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

/// Most columns along one side of a surface's bounding box; more cost more memory than they save time.
const COLUMNS_MAX: f64 = 1024.0;

/// Answers which region holds a point, by one watertight ray per surface along z.
#[derive(Debug)]
pub(super) struct PointQuery<'a> {
    surfaces: Vec<Binned<'a>>,
}

/// A surface with its triangles sorted into square columns along z.
#[derive(Debug)]
struct Binned<'a> {
    surface: &'a Surface,
    low: [f64; 2],
    side: f64,
    count: [usize; 2],
    start: Vec<u32>,
    triangles: Vec<BinEntry>,
}

/// A triangle in a column, with what rules most of them out at a glance.
#[derive(Debug, Clone, Copy)]
struct BinEntry {
    triangle: u32,
    x: [f64; 2],
    y: [f64; 2],
    z_min: f64,
}

impl<'a> PointQuery<'a> {
    /// Sorts the triangles of all surfaces into columns.
    pub(super) fn new(surfaces: &[&'a Surface]) -> Self {
        Self {
            surfaces: surfaces.par_iter().map(|s| Binned::new(s)).collect(),
        }
    }

    /// The region at a point, overlaps resolved, or `None` outside all of them.
    pub(super) fn region_at(&self, point: Vec3) -> Option<usize> {
        (0..self.surfaces.len())
            .rev()
            .find(|&r| self.surfaces[r].contains(point))
    }

    /// Whether region `r`'s own surface contains the point, whoever else does.
    pub(super) fn contains(&self, region: usize, point: Vec3) -> bool {
        self.surfaces[region].contains(point)
    }
}

impl BinEntry {
    fn new(surface: &Surface, triangle: u32) -> Self {
        let corners = surface.corners(triangle as usize);
        let low = corners[0].inf(&corners[1]).inf(&corners[2]);
        let high = corners[0].sup(&corners[1]).sup(&corners[2]);
        Self {
            triangle,
            x: [low.x, high.x],
            y: [low.y, high.y],
            z_min: low.z,
        }
    }

    fn may_lie_below(&self, point: &Vec3) -> bool {
        self.z_min < point.z
            && self.x[0] <= point.x
            && point.x <= self.x[1]
            && self.y[0] <= point.y
            && point.y <= self.y[1]
    }
}

impl<'a> Binned<'a> {
    fn new(surface: &'a Surface) -> Self {
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for v in &surface.vertices {
            for a in 0..2 {
                low[a] = low[a].min(v[a]);
                high[a] = high[a].max(v[a]);
            }
        }
        // Columns half as wide as the mean triangle: a steep wall then puts few triangles into each.
        let extent = (high[0] - low[0]).max(high[1] - low[1]);
        let triangle = (surface.area() / surface.triangles.len().max(1) as f64).sqrt();
        let side = (triangle / 2.0)
            .max(extent / COLUMNS_MAX)
            .max(f64::MIN_POSITIVE);
        let count =
            [0, 1].map(|a| (((high[a] - low[a]) / side).floor() as usize).saturating_add(1));
        let mut this = Self {
            surface,
            low,
            side,
            count,
            start: Vec::new(),
            triangles: Vec::new(),
        };
        let mut pairs = Vec::new();
        for (index, triangle) in surface.triangles.iter().enumerate() {
            let corners = triangle.map(|v| surface.vertices[v as usize]);
            let range = |a: usize| {
                let values = corners.map(|p| p[a]);
                let low = values.iter().copied().fold(f64::INFINITY, f64::min);
                let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                this.bin(a, low)..=this.bin(a, high)
            };
            for j in range(1) {
                for i in range(0) {
                    pairs.push(((i + count[0] * j) as u32, index as u32));
                }
            }
        }
        pairs.sort_unstable();
        let mut start = vec![0_u32; count[0] * count[1] + 1];
        for (bin, _) in &pairs {
            start[*bin as usize + 1] += 1;
        }
        for bin in 1..start.len() {
            start[bin] += start[bin - 1];
        }
        this.start = start;
        this.triangles = pairs
            .into_iter()
            .map(|(_, t)| BinEntry::new(surface, t))
            .collect();
        this
    }

    fn bin(&self, axis: usize, x: f64) -> usize {
        (((x - self.low[axis]) / self.side).floor().max(0.0) as usize).min(self.count[axis] - 1)
    }

    fn contains(&self, point: Vec3) -> bool {
        let bin = self.bin(0, point.x) + self.count[0] * self.bin(1, point.y);
        let range = self.start[bin] as usize..self.start[bin + 1] as usize;
        let rays = Rays {
            axis: 2,
            first: [point.x, point.y],
            step: 1.0,
            count: [1, 1],
        };
        let mut winding = 0_i32;
        let mut found = Vec::new();
        for entry in self.triangles[range]
            .iter()
            .filter(|e| e.may_lie_below(&point))
        {
            let corners = self.surface.corners(entry.triangle as usize);
            found.clear();
            super::rays::cast_triangle(&corners, &rays, &mut found);
            for (_, hit) in &found {
                if hit.depth < point.z {
                    winding += i32::from(hit.turn);
                }
            }
        }
        winding > 0
    }
}
