//! The stretches of rays within each region, and their connectivity.
//!
//! Neighbouring rays are a quarter of a cell apart, and stretches of one region side by side are connected. So
//! even a part too thin for a cell of its own is assigned to the part it is connected to.

use std::ops::Range;

use rayon::prelude::*;

use super::grid::Grid;
use super::label::Sweep;
use super::rays::{Hits, Rays, cast};
use crate::Surface;
use crate::surface::Sets;

/// Rays across a cell along x and along y.
pub(super) const RAYS_PER_CELL: usize = 4;

/// A gap or a strand that is shorter than this, in cells, is rounding.
pub(super) const NOTHING: f64 = 1e-6;

/// Parts of the input closer together than this, in spacings, touch.
const GAP_MIN: f64 = 1.0 / RAYS_PER_CELL as f64;

/// A piece of a ray within one region.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strand {
    pub(super) region: u8,
    /// Where it begins and ends, in cells along z.
    pub(super) from: f64,
    pub(super) to: f64,
}

/// The strands of all rays along z, overlaps resolved.
pub(super) struct Strands {
    /// Rays along x.
    width: usize,
    /// First strand of each ray, and one past the last of all.
    start: Vec<u32>,
    all: Vec<Strand>,
    /// The part of its region that each strand belongs to.
    parts: Vec<u32>,
}

impl Strands {
    /// Sends rays through all surfaces.
    pub(super) fn new(grid: &Grid, surfaces: &[&Surface]) -> Self {
        let step = grid.spacing / RAYS_PER_CELL as f64;
        let rays = Rays {
            axis: 2,
            first: [grid.origin.x + step / 2.0, grid.origin.y + step / 2.0],
            step,
            count: [0, 1].map(|a| grid.cells[a] * RAYS_PER_CELL),
        };
        let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
        let [width, height] = rays.count;
        let rows: Vec<(Vec<u32>, Vec<Strand>)> = (0..height)
            .into_par_iter()
            .map(|v| row(grid, &hits, &rays, v))
            .collect();
        let mut this = Self {
            width,
            start: vec![0],
            all: Vec::with_capacity(rows.iter().map(|r| r.1.len()).sum()),
            parts: Vec::new(),
        };
        for (ends, mut strands) in rows {
            let before = this.all.len() as u32;
            this.start.extend(ends.iter().map(|e| before + e));
            this.all.append(&mut strands);
        }
        this.join();
        this
    }

    /// The strands of a ray from low to high, each with its part of the region.
    pub(super) fn of(&self, [u, v]: [usize; 2]) -> impl Iterator<Item = (&Strand, u32)> {
        let range = self.range(u + self.width * v);
        self.all[range.clone()]
            .iter()
            .zip(self.parts[range].iter().copied())
    }

    /// The pairs of parts that touch along a ray, or at one height of two neighbouring rays: a gap of a quarter of
    /// a cell always has a ray in it. Both ways, sorted.
    pub(super) fn touching(&self) -> Vec<[u32; 2]> {
        let rays = self.start.len() - 1;
        let rows: Vec<Vec<[u32; 2]>> = (0..rays / self.width)
            .into_par_iter()
            .map(|row| {
                let mut pairs = Vec::new();
                for ray in row * self.width..(row + 1) * self.width {
                    let own = self.range(ray);
                    for strand in own.clone().skip(1) {
                        if self.all[strand].from - self.all[strand - 1].to < GAP_MIN {
                            self.pair(strand - 1, strand, &mut pairs);
                        }
                    }
                    let right = Some(ray + 1).filter(|r| r % self.width != 0);
                    let above = Some(ray + self.width).filter(|r| *r < rays);
                    for other in [right, above].into_iter().flatten() {
                        self.side_by_side(own.clone(), self.range(other), |a, b| {
                            self.pair(a, b, &mut pairs);
                        });
                    }
                }
                pairs.sort_unstable();
                pairs.dedup();
                pairs
            })
            .collect();
        let mut pairs = rows.concat();
        pairs.par_sort_unstable();
        pairs.dedup();
        pairs
    }

    fn pair(&self, a: usize, b: usize, pairs: &mut Vec<[u32; 2]>) {
        let [p, q] = [self.parts[a], self.parts[b]];
        if p != q && pairs.last() != Some(&[q, p]) {
            pairs.extend([[p, q], [q, p]]);
        }
    }

    fn range(&self, ray: usize) -> Range<usize> {
        self.start[ray] as usize..self.start[ray + 1] as usize
    }

    /// Connects adjacent strands.
    fn join(&mut self) {
        let mut sets = Sets::new(self.all.len());
        for ray in 0..self.start.len() - 1 {
            if (ray + 1) % self.width != 0 {
                self.join_rays(&mut sets, ray, ray + 1);
            }
            if ray + self.width < self.start.len() - 1 {
                self.join_rays(&mut sets, ray, ray + self.width);
            }
        }
        let all = 0..self.all.len() as u32;
        self.parts = all.map(|strand| sets.find(strand)).collect();
    }

    fn join_rays(&self, sets: &mut Sets, one: usize, other: usize) {
        self.side_by_side(self.range(one), self.range(other), |a, b| {
            if self.all[a].region == self.all[b].region {
                sets.join(a as u32, b as u32);
            }
        });
    }

    /// Calls `each` with the strands of two rays that have a height in common.
    fn side_by_side(
        &self,
        one: Range<usize>,
        other: Range<usize>,
        mut each: impl FnMut(usize, usize),
    ) {
        let (mut a, mut b) = (one.start, other.start);
        while a < one.end && b < other.end {
            let (s, t) = (&self.all[a], &self.all[b]);
            if s.from.max(t.from) < s.to.min(t.to) {
                each(a, b);
            }
            if s.to < t.to {
                a += 1;
            } else {
                b += 1;
            }
        }
    }
}

/// The strands of a row of rays, and their number up to the end of each ray.
fn row(grid: &Grid, hits: &[Hits], rays: &Rays, v: usize) -> (Vec<u32>, Vec<Strand>) {
    let at = |z: f64| (z - grid.origin.z) / grid.spacing;
    let mut strands: Vec<Strand> = Vec::new();
    let mut ends = Vec::with_capacity(rays.count[0]);
    let mut sweep = Sweep::default();
    for u in 0..rays.count[0] {
        let first = strands.len();
        sweep.resolve(hits, rays.index([u, v]), |region, from, to| {
            let (region, from, to) = (region as u8, at(from), at(to));
            match strands[first..].last_mut() {
                Some(last) if last.region == region && from - last.to < NOTHING => last.to = to,
                _ if to - from < NOTHING => {}
                _ => strands.push(Strand { region, from, to }),
            }
        });
        ends.push(strands.len() as u32);
    }
    (ends, strands)
}
