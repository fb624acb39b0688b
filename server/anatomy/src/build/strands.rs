//! The stretches of rays within each region, and their connectivity.
//!
//! Neighbouring rays are a quarter of a cell apart, and stretches of one region side by side are connected. So
//! even a part too thin for a cell of its own is assigned to the part it is connected to. Where the walls of closed parts
//! are known, strands that end on one wall belong to one component, however far apart the rays are.

use rayon::prelude::*;

use super::grid::Grid;
use super::label::Sweep;
use super::rays::{Hits, Rays, cast};
use crate::Surface;
use crate::surface::Sets;

/// Rays across a cell along x and along y.
pub(super) const RAYS_PER_CELL: usize = 4;

/// A gap or a strand that is shorter than this, in units of the rays, is rounding.
pub(super) const NOTHING: f64 = 1e-6;

/// Parts of the input closer together than this, in spacings, touch.
const GAP_MIN: f64 = 1.0 / RAYS_PER_CELL as f64;

/// A piece of a ray within one region.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strand {
    pub(super) region: u8,
    /// Where it begins and ends: in cells along z, or in the unit of the rays.
    pub(super) from: f64,
    pub(super) to: f64,
}

/// The strands of a row of rays, and their number up to the end of each ray.
pub(super) type Row = (Vec<u32>, Vec<Strand>);

/// How strands side by side are connected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Touching {
    /// By a common face: neighbouring rays have a stretch in common.
    Face,
    /// By a common face or edge, as voxels are.
    Edge,
}

/// Number of an end that lies on no wall.
pub(super) const NO_WALL: u32 = u32::MAX;

/// Walls that strands end on.
pub(super) struct WallEnds {
    /// The wall at either end of each strand, or [`NO_WALL`].
    pub(super) of: Vec<[u32; 2]>,
    /// Whether the region lies behind all of a wall, and another one or nothing before it.
    pub(super) is_whole: Vec<bool>,
}

impl WallEnds {
    fn whole_of(&self, strand: usize) -> [Option<u32>; 2] {
        let whole = |wall: &u32| *wall != NO_WALL && self.is_whole[*wall as usize];
        self.of[strand].map(|wall| Some(wall).filter(whole))
    }
}

/// The strands of parallel rays, overlaps resolved.
pub(super) struct Strands {
    /// Rays of a row.
    width: usize,
    /// First strand of each ray, and one past the last of all.
    start: Vec<u32>,
    all: Vec<Strand>,
    /// The part of its region that each strand belongs to.
    parts: Vec<u32>,
}

impl Strands {
    /// Sends rays along z through all surfaces.
    pub(super) fn new(grid: &Grid, surfaces: &[&Surface]) -> Self {
        let step = grid.spacing / RAYS_PER_CELL as f64;
        let rays = Rays {
            axis: 2,
            first: [grid.origin.x + step / 2.0, grid.origin.y + step / 2.0],
            step,
            count: [0, 1].map(|a| grid.cells[a] * RAYS_PER_CELL),
        };
        let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
        Self::of_hits(&hits, &rays, grid.origin.z, grid.spacing)
    }

    /// The strands of rays with the hits of each region's surface, measured from `origin` in this unit.
    pub(super) fn of_hits(hits: &[Hits], rays: &Rays, origin: f64, unit: f64) -> Self {
        let [width, height] = rays.count;
        let at = |depth: f64| (depth - origin) / unit;
        let rows = (0..height).into_par_iter();
        let rows: Vec<Row> = rows.map(|v| row(hits, rays, v, &at)).collect();
        Self::of_rows(width, rows, Touching::Face)
    }

    /// Connects the strands again, except those side by side that whole walls of their own bound at either end: the parts are
    /// pieces. Returns the component of each strand: pieces that share a whole wall are one.
    pub(super) fn join_by_walls(&mut self, ends: &WallEnds) -> Vec<u32> {
        let mut sets = Sets::new(self.all.len());
        let mut first = vec![NO_WALL; ends.is_whole.len()];
        for strand in 0..self.all.len() {
            for wall in ends.whole_of(strand).into_iter().flatten() {
                let first = &mut first[wall as usize];
                if *first == NO_WALL {
                    *first = strand as u32;
                }
                sets.join(*first, strand as u32);
            }
        }
        let same: Vec<u32> = (0..self.all.len() as u32).map(|s| sets.find(s)).collect();
        let is_bounded = |strand: usize| ends.whole_of(strand).iter().all(Option::is_some);
        self.join(Touching::Face, |a, b| {
            same[a] != same[b] && is_bounded(a) && is_bounded(b)
        });
        for (strand, part) in self.parts.iter().enumerate() {
            sets.join(strand as u32, *part);
        }
        (0..self.all.len() as u32).map(|s| sets.find(s)).collect()
    }

    /// The strands of rows of `width` rays each.
    pub(super) fn of_rows(width: usize, rows: Vec<Row>, touching: Touching) -> Self {
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
        this.join(touching, |_, _| false);
        this
    }

    /// The strands of a ray from low to high, each with its part of the region.
    pub(super) fn of(&self, [u, v]: [usize; 2]) -> impl Iterator<Item = (&Strand, u32)> {
        let range = self.range(u + self.width * v);
        self.all[range.clone()]
            .iter()
            .zip(self.parts[range].iter().copied())
    }

    /// For each of the regions whose hits these strands come from, the part of its rays that no later region covers.
    pub(super) fn kept(&self, hits: &[Hits]) -> Vec<f64> {
        let [width, height] = self.size();
        let rows: Vec<Vec<[f64; 2]>> = (0..height)
            .into_par_iter()
            .map(|v| {
                let mut sums = vec![[0.0; 2]; hits.len()];
                for u in 0..width {
                    for (hits, sums) in hits.iter().zip(&mut sums) {
                        hits.inside(u + width * v, |from, to| sums[0] += to - from);
                    }
                    for (strand, _) in self.of([u, v]) {
                        sums[usize::from(strand.region)][1] += strand.to - strand.from;
                    }
                }
                sums
            })
            .collect();
        // Rows are summed in order: the same sum on any number of threads.
        let sum = |r: usize, which: usize| rows.iter().map(|row| row[r][which]).sum::<f64>();
        let kept = (0..hits.len()).map(|r| match sum(r, 0) {
            whole if whole > 0.0 => sum(r, 1) / whole,
            _ => 1.0,
        });
        kept.collect()
    }

    /// Number of rays in a row, and of rows.
    pub(super) fn size(&self) -> [usize; 2] {
        [self.width, (self.start.len() - 1) / self.width.max(1)]
    }

    /// Number of strands; parts have smaller numbers.
    pub(super) fn len(&self) -> usize {
        self.all.len()
    }

    /// A strand by its number, and its part of the region.
    pub(super) fn strand(&self, number: usize) -> (&Strand, u32) {
        (&self.all[number], self.parts[number])
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
                    for strand in self.range(ray).skip(1) {
                        if self.all[strand].from - self.all[strand - 1].to < GAP_MIN {
                            self.pair(strand - 1, strand, &mut pairs);
                        }
                    }
                    let right = Some(ray + 1).filter(|r| r % self.width != 0);
                    let above = Some(ray + self.width).filter(|r| *r < rays);
                    for other in [right, above].into_iter().flatten() {
                        self.side_by_side([ray, other], false, |a, b| {
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

    /// The numbers of the strands of a ray.
    pub(super) fn range(&self, ray: usize) -> std::ops::Range<usize> {
        self.start[ray] as usize..self.start[ray + 1] as usize
    }

    /// Connects adjacent strands, unless they are `apart`.
    fn join(&mut self, touching: Touching, apart: impl Fn(usize, usize) -> bool + Copy) {
        let mut sets = Sets::new(self.all.len());
        let (width, rays) = (self.width, self.start.len() - 1);
        let edges = touching == Touching::Edge;
        for ray in 0..rays {
            let column = ray % width;
            let above = ray + width < rays;
            if column + 1 < width {
                self.join_rays(&mut sets, [ray, ray + 1], edges, apart);
            }
            if above {
                self.join_rays(&mut sets, [ray, ray + width], edges, apart);
            }
            if edges && above && column + 1 < width {
                self.join_rays(&mut sets, [ray, ray + width + 1], false, apart);
            }
            if edges && above && column > 0 {
                self.join_rays(&mut sets, [ray, ray + width - 1], false, apart);
            }
        }
        let all = 0..self.all.len() as u32;
        self.parts = all.map(|strand| sets.find(strand)).collect();
    }

    /// Connects the strands of two rays that have a stretch in common, or with `ends` at least an end.
    fn join_rays(
        &self,
        sets: &mut Sets,
        [one, other]: [usize; 2],
        ends: bool,
        apart: impl Fn(usize, usize) -> bool,
    ) {
        self.side_by_side([one, other], ends, |a, b| {
            if self.all[a].region == self.all[b].region && !apart(a, b) {
                sets.join(a as u32, b as u32);
            }
        });
    }

    /// Calls `each` with the strands of two rays that have a stretch in common, or with `ends` at least an end.
    fn side_by_side(
        &self,
        [one, other]: [usize; 2],
        ends: bool,
        mut each: impl FnMut(usize, usize),
    ) {
        let (one, other) = (self.range(one), self.range(other));
        let mut meet = |a: usize, b: usize| {
            let (s, t) = (&self.all[a], &self.all[b]);
            let (from, to) = (s.from.max(t.from), s.to.min(t.to));
            if from < to || (ends && from <= to) {
                each(a, b);
            }
        };
        let (mut a, mut b) = (one.start, other.start);
        while a < one.end && b < other.end {
            let (s, t) = (&self.all[a], &self.all[b]);
            meet(a, b);
            // Where both end together, each also meets the next one of the other.
            if ends && s.to == t.to && a + 1 < one.end {
                meet(a + 1, b);
            }
            if s.to < t.to {
                a += 1;
            } else {
                b += 1;
            }
        }
    }
}

fn row(hits: &[Hits], rays: &Rays, v: usize, at: &(impl Fn(f64) -> f64 + Sync)) -> Row {
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
