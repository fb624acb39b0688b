//! One V-cycle over the coarse levels, on the points that have something to do.
//!
//! Level by level: smooth the loaded points and their neighbours, hand what is left over to the
//! next coarser level, add its answer, smooth again. The correction of the first level survives the
//! cycle: it is poured into the nodes where it is large enough to matter ([`Hierarchy::pour`]), and
//! what is not stays as the first guess of the next cycle.

use super::block::{Block, EMPTY, Quad, ZERO, accumulate, add_scaled, inverse, square};
use super::hierarchy::{Extra, Hierarchy, Level, NONE, Tie, slot};

/// Sweeps on the coarsest level, which stand for a solve.
const COARSEST_SWEEPS: usize = 8;
/// Points with added stiffness per level at most: 64 tools of 64 contact nodes; what lies beyond is
/// left to the fine level.
const EXTRA_MAX: usize = 4096;

impl Level {
    #[inline]
    pub(crate) fn load(&mut self, point: u32, value: &Quad) {
        self.loaded.insert(point);
        let rhs = &mut self.rhs[point as usize];
        for a in 0..3 {
            rhs[a] += value[a];
        }
    }

    #[inline]
    fn residual(&self, point: u32) -> Quad {
        let p = point as usize;
        let mut sum = ZERO;
        for (block, &other) in self.rows[p].iter().zip(&self.around[p]) {
            accumulate(&mut sum, block, &self.e[other as usize]);
        }
        if self.extra_of[p] != NONE {
            let extra = &self.extra[self.extra_of[p] as usize];
            for (block, &other) in extra.row.iter().zip(&self.around[p]) {
                accumulate(&mut sum, block, &self.e[other as usize]);
            }
        }
        let rhs = &self.rhs[p];
        std::array::from_fn(|a| rhs[a] - sum[a])
    }

    fn relax(&mut self, point: u32) {
        let r = self.residual(point);
        let p = point as usize;
        let block: &Block = match self.extra_of[p] {
            NONE => &self.inverse[p],
            extra => &self.extra[extra as usize].inverse,
        };
        let mut step = ZERO;
        accumulate(&mut step, block, &r);
        for (e, step) in self.e[p].iter_mut().zip(step) {
            *e += step;
        }
    }

    fn smooth(&mut self, backward: bool) {
        let items = std::mem::take(&mut self.smoothed.items);
        if backward {
            for &p in items.iter().rev() {
                self.relax(p);
            }
        } else {
            for &p in &items {
                self.relax(p);
            }
        }
        self.smoothed.items = items;
    }

    /// Chooses the points to smooth: those loaded beyond the threshold and their neighbours.
    fn choose(&mut self, threshold: f32) {
        let absent = self.at.len() as u32;
        for &point in &self.loaded.items {
            if square(&self.rhs[point as usize]) > threshold * threshold {
                for other in self.around[point as usize] {
                    if other != absent {
                        self.smoothed.insert(other);
                    }
                }
            }
        }
        for &point in &self.smoothed.items {
            self.live.insert(point);
            for other in self.around[point as usize] {
                if other != absent {
                    self.ring.insert(other);
                }
            }
        }
    }

    /// Adds `weight · block` to what stands beside the row of `point` at slot `s`.
    fn stiffen(&mut self, point: u32, s: usize, block: &Block, weight: f32) {
        let entry = &mut self.extra_of[point as usize];
        if *entry == NONE {
            if self.extra.len() >= EXTRA_MAX {
                return;
            }
            *entry = self.extra.len() as u32;
            self.extra.push(Extra {
                point,
                row: [EMPTY; 27],
                inverse: EMPTY,
            });
        }
        add_scaled(&mut self.extra[*entry as usize].row[s], block, weight);
    }
}

impl Hierarchy {
    /// Forgets all added stiffness.
    pub(crate) fn clear_extra(&mut self) {
        for level in &mut self.levels {
            for extra in level.extra.drain(..) {
                level.extra_of[extra.point as usize] = NONE;
            }
        }
    }

    /// Adds the block that couples nodes `a` and `b` to the first level.
    pub(crate) fn add_extra(&mut self, a: u32, b: u32, block: &Block) {
        let level = &mut self.levels[0];
        for &(i, wi) in self.parents[a as usize].iter() {
            for &(j, wj) in self.parents[b as usize].iter() {
                if let Some(s) = slot(level.at[i as usize], level.at[j as usize]) {
                    level.stiffen(i, s, block, wi * wj);
                }
            }
        }
    }

    /// Carries the added stiffness to all levels.
    pub(crate) fn spread_extra(&mut self) {
        for l in 0..self.levels.len() {
            let (finer, coarser) = self.levels.split_at_mut(l + 1);
            let level = &mut finer[l];
            for extra in &mut level.extra {
                let p = extra.point as usize;
                let mut own = level.rows[p][13];
                add_scaled(&mut own, &extra.row[13], 1.0);
                extra.inverse = inverse(&own);
            }
            let Some(next) = coarser.first_mut() else {
                break;
            };
            for extra in &level.extra {
                let p = extra.point as usize;
                for (block, &other) in extra.row.iter().zip(&level.around[p]) {
                    if other as usize == level.at.len() || *block == EMPTY {
                        continue;
                    }
                    for &(i, wi) in level.parents[p].iter() {
                        for &(j, wj) in level.parents[other as usize].iter() {
                            if let Some(s) = slot(next.at[i as usize], next.at[j as usize]) {
                                next.stiffen(i, s, block, wi * wj);
                            }
                        }
                    }
                }
            }
        }
    }

    /// One V-cycle for the loads on the first level. Returns the points visited.
    pub(crate) fn cycle(&mut self, threshold: f64) -> usize {
        let threshold = threshold as f32;
        let last = self.levels.len() - 1;
        let mut visited = 0;
        for l in 0..=last {
            let (finer, coarser) = self.levels.split_at_mut(l + 1);
            let level = &mut finer[l];
            level.choose(threshold);
            visited += 2 * level.smoothed.items.len() + level.ring.items.len();
            if l == last {
                for sweep in 0..COARSEST_SWEEPS {
                    level.smooth(sweep % 2 == 1);
                }
                break;
            }
            level.smooth(false);
            let next = &mut coarser[0];
            for &point in &level.ring.items {
                let r = level.residual(point);
                for &(parent, w) in level.parents[point as usize].iter() {
                    next.load(parent, &r.map(|v| v * w));
                }
            }
        }
        for l in (0..last).rev() {
            let (finer, coarser) = self.levels.split_at_mut(l + 1);
            let (level, next) = (&mut finer[l], &mut coarser[0]);
            for &point in &next.live.items {
                let e = std::mem::replace(&mut next.e[point as usize], ZERO);
                for &(child, w) in &next.children[point as usize] {
                    level.live.insert(child);
                    for (to, e) in level.e[child as usize].iter_mut().zip(e) {
                        *to += w * e;
                    }
                }
            }
            next.live.clear();
            level.smooth(true);
        }
        for level in &mut self.levels {
            for &point in &level.loaded.items {
                level.rhs[point as usize] = ZERO;
            }
            level.loaded.clear();
            level.smoothed.clear();
            level.ring.clear();
        }
        visited
    }

    /// Hands out the correction at every point where it is worth more than `least` newtons, as
    /// `(children, correction, kink)`: the kink is how far what is handed out there is from the mean
    /// of what is handed out around, which measures the force that pouring it leaves behind.
    pub(crate) fn pour(&mut self, least: f64, mut take: impl FnMut(&[Tie], Quad, f32)) {
        const SIX: [usize; 6] = [4, 10, 12, 14, 16, 22];
        let level = &mut self.levels[0];
        let least = (least * least) as f32;
        let worth = |e: &Quad, own: f32| square(e) * own * own > least;
        for &point in &level.live.items {
            let p = point as usize;
            let e = level.e[p];
            if !worth(&e, level.own[p]) || !square(&e).is_finite() {
                continue;
            }
            let mut mean = ZERO;
            for s in SIX {
                let other = level.around[p][s] as usize;
                let v = match level.own.get(other) {
                    None => &e,
                    Some(&own) if worth(&level.e[other], own) => &level.e[other],
                    Some(_) => &ZERO,
                };
                for a in 0..3 {
                    mean[a] += v[a] / 6.0;
                }
            }
            let kink = square(&std::array::from_fn(|a| e[a] - mean[a])).sqrt();
            take(&level.children[p], e, kink);
        }
        let (e, own) = (&mut level.e, &level.own);
        level.live.retain(|point| {
            let v = &mut e[point as usize];
            if worth(v, own[point as usize]) || !square(v).is_finite() {
                *v = ZERO;
            }
            *v != ZERO
        });
    }

    /// Drops the loads of a cycle that is not run.
    pub(crate) fn unload(&mut self) {
        let level = &mut self.levels[0];
        for &point in &level.loaded.items {
            level.rhs[point as usize] = ZERO;
        }
        level.loaded.clear();
    }

    /// Drops every correction that was not poured out.
    pub(crate) fn forget(&mut self) {
        for level in &mut self.levels {
            for &point in &level.live.items {
                level.e[point as usize] = ZERO;
            }
            level.live.clear();
        }
    }
}
