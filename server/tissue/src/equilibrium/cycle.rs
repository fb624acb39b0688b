//! One V-cycle over the coarse lattices: what the forces left on the finer level ask for.
//!
//! Chebyshev iterations smooth on every level (their polynomial needs no order of points, so they
//! run element by element in vectors); each level hands what is left over to the next coarser one
//! and adds its answer.

use pulp::{Arch, Simd, WithSimd};

use super::block::{Quad, ZERO};
use super::coarsen::Ties;
use super::element::{SIZE, at, multiply};
use super::patch::{Corners, NONE, Overlay, Patch, apply, invert, take_over};
use super::structure::{Level, Structure};

/// Lowest eigenvalue that smoothing looks after, in parts of the bound on all.
pub(super) const LOW: f32 = 0.15;
/// The same on the coarsest level.
const LOW_COARSEST: f32 = 0.02;
/// How much a V-cycle does.
#[derive(Clone, Copy)]
pub(super) struct Effort {
    /// Smoothing steps on each level before the correction of the coarser one, and after it.
    pub(super) before: usize,
    pub(super) after: usize,
    /// Steps on the coarsest level, which stand for a solve.
    pub(super) coarsest: usize,
    /// Load in thresholds on a point outside of the set from which on it is to be let in.
    pub(super) loaded: f32,
}

/// The factors of a Chebyshev iteration on [low, 1] times the bound.
pub(super) struct Chebyshev {
    theta: f32,
    delta: f32,
    rho: f32,
}

impl Chebyshev {
    pub(super) fn new(low: f32) -> Self {
        let (theta, delta) = (0.5 * (1.0 + low), 0.5 * (1.0 - low));
        Self {
            theta,
            delta,
            rho: 0.0,
        }
    }

    /// Factors of the last step and of the scaled residual.
    pub(super) fn next(&mut self) -> (f32, f32) {
        if self.rho == 0.0 {
            self.rho = self.delta / self.theta;
            return (0.0, 1.0 / self.theta);
        }
        let rho = 1.0 / (2.0 * self.theta / self.delta - self.rho);
        let factors = (rho * self.rho, 2.0 * rho / self.delta);
        self.rho = rho;
        factors
    }
}

/// The coarse lattices of one shape.
pub(super) struct Multigrid {
    pub(super) patches: Vec<Patch>,
    arch: Arch,
    /// Force on a corner of an element of level 1, in thresholds, above which it is refined.
    pub(super) pending: f32,
    /// Elements visited.
    pub(super) visits: usize,
}

impl Multigrid {
    pub(super) fn new(structure: &Structure) -> Self {
        Self {
            patches: structure.levels.iter().map(Patch::new).collect(),
            arch: Arch::new(),
            pending: 1.0,
            visits: 0,
        }
    }

    /// The same on level l + 1, in N: what coarse elements get wrong is a smaller part of a larger force.
    fn tolerable(&self, l: usize, threshold: f32) -> f32 {
        self.pending * threshold * (1 << l) as f32
    }

    /// Chooses what takes part on every level around the refined elements of level 1; `more` adds
    /// to what was chosen before.
    pub(super) fn select(&mut self, structure: &Structure, more: bool) {
        let last = self.patches.len() - 1;
        for l in 0..last {
            let level = &structure.levels[l];
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let (patch, above) = (&finer[l], &mut coarser[0]);
            if !more {
                above.refined.clear();
            }
            for element in above.wanted.take() {
                above.refined.insert(element);
            }
            // One ring around what is refined, so that its points can move.
            for &element in &patch.refined.items {
                for point in level.corners[element as usize] {
                    for &other in level.around.row(point) {
                        above.refined.insert(level.parent[other as usize]);
                    }
                }
            }
            above.refined.sort();
        }
        for l in (0..=last).rev() {
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let above = coarser
                .first()
                .map(|p| (&structure.levels[l + 1], &p.refined));
            finer[l].choose(&structure.levels[l], above);
        }
    }

    /// Hands pending displacements down to what is refined now. Returns whether that makes more
    /// elements want to be refined.
    pub(super) fn push(&mut self, structure: &Structure, threshold: f32) -> bool {
        for l in (0..self.patches.len()).rev() {
            take_over(structure, &mut self.patches, l, false);
        }
        for l in (1..self.patches.len()).rev() {
            let tolerable = self.tolerable(l - 1, threshold);
            let (finer, coarser) = self.patches.split_at_mut(l);
            let (below, patch) = (&mut finer[l - 1], &mut coarser[0]);
            let (level, level_below) = (&structure.levels[l], &structure.levels[l - 1]);
            for i in 0..patch.refined.items.len() {
                let element = patch.refined.items[i];
                if !patch.waiting[element as usize] {
                    continue;
                }
                let pending = patch.take_pending(level, element);
                for &child in level.children.row(element) {
                    let by = to_child(&pending, level_below.octant[child as usize]);
                    let force = below.wait(level_below, child, &by);
                    if force > tolerable && !below.refined.contains(child) {
                        below.wanted.insert(child);
                    }
                }
            }
            patch.trim();
        }
        let patch = &mut self.patches[0];
        for i in 0..patch.refined.items.len() {
            let element = patch.refined.items[i];
            if patch.waiting[element as usize] {
                patch.take_pending(&structure.levels[0], element);
            }
        }
        patch.trim();
        self.patches.iter().any(|p| !p.wanted.items.is_empty())
    }

    /// One V-cycle for the loads on level 1; leaves the correction in every patch's `e`.
    pub(super) fn cycle(&mut self, structure: &Structure, threshold: f32, effort: Effort) {
        let last = self.patches.len() - 1;
        for l in 0..=last {
            let level = &structure.levels[l];
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let patch = &mut finer[l];
            for i in 0..patch.lagging.items.len() {
                let point = patch.lagging.items[i];
                let lag = patch.lag[point as usize];
                patch.load(point, &lag, 1.0);
            }
            for &point in &patch.points.items {
                let p = point as usize;
                patch.e[p] = ZERO;
                patch.r[p] = if patch.loaded.contains(point) {
                    patch.b[p]
                } else {
                    ZERO
                };
            }
            let (steps, low) = if l == last {
                (effort.coarsest, LOW_COARSEST)
            } else {
                (effort.before, LOW)
            };
            self.visits += (1 + steps) * patch.set.items.len();
            self.arch.dispatch(Smooth {
                level,
                patch,
                steps,
                low,
                moved: false,
            });
            let Some(next) = coarser.first_mut() else {
                continue;
            };
            for &point in &patch.points.items {
                restrict(&level.ties[point as usize], &patch.r[point as usize], next);
            }
            for &point in &patch.loaded.items {
                if patch.inside[point as usize] == 0 {
                    let b = patch.b[point as usize];
                    restrict(&level.ties[point as usize], &b, next);
                    if square(&b) > (effort.loaded * threshold).powi(2) {
                        for &element in level.around.row(point) {
                            next.wanted.insert(level.parent[element as usize]);
                        }
                    }
                }
            }
        }
        for l in (0..last).rev() {
            let level = &structure.levels[l];
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let (patch, above) = (&mut finer[l], &coarser[0]);
            for &point in &patch.points.items {
                let v = interpolate(&level.ties[point as usize], &above.e);
                let p = point as usize;
                patch.d[p] = v;
                for a in 0..3 {
                    patch.e[p][a] += v[a];
                }
            }
            self.visits += effort.after * patch.set.items.len();
            self.arch.dispatch(Smooth {
                level,
                patch,
                steps: effort.after,
                low: LOW,
                moved: true,
            });
        }
        for patch in &mut self.patches {
            patch.loaded.clear();
        }
    }

    /// Begins a step: what the last one corrected becomes the correction that may be taken once more.
    pub(super) fn recall(&mut self) {
        for patch in &mut self.patches {
            for &point in &patch.points.items {
                let p = point as usize;
                patch.e[p] = if patch.gained.contains(point) {
                    patch.gain[p]
                } else {
                    ZERO
                };
            }
            patch.gained.clear();
        }
    }

    /// Work of what waits along the correction, before it and after it, in N m: that of the lag, and of
    /// the elements that are not refined.
    pub(super) fn work_along(&self, structure: &Structure) -> [f64; 2] {
        let (mut before, mut curve) = (0.0, 0.0);
        for (patch, level) in self.patches.iter().zip(&structure.levels) {
            for &point in &patch.lagging.items {
                let p = point as usize;
                if patch.inside[p] > 0 {
                    before += dot(&patch.lag[p], &patch.e[p]);
                }
            }
            curve += self.arch.dispatch(Curve { level, patch });
        }
        [before, before - curve]
    }

    /// Takes over `share` of the correction: displacements in full, forces of what is not refined
    /// as pending. Notes what is to be refined next.
    pub(super) fn commit(&mut self, structure: &Structure, share: f32, threshold: f32) {
        for l in (0..self.patches.len()).rev() {
            let level = &structure.levels[l];
            let tolerable = self.tolerable(l, threshold);
            let patch = &mut self.patches[l];
            for &point in &patch.points.items {
                let p = point as usize;
                if patch.gained.insert(point) {
                    patch.gain[p] = ZERO;
                }
                for a in 0..3 {
                    patch.total[p][a] += f64::from(share) * f64::from(patch.e[p][a]);
                    patch.gain[p][a] += share * patch.e[p][a];
                }
            }
            self.arch.dispatch(Defer {
                level,
                patch,
                share,
                threshold: tolerable,
            });
            // What the coarser level did is part of e: it counts as taken over.
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            if let Some(above) = coarser.first() {
                let patch = &mut finer[l];
                for &point in &patch.points.items {
                    patch.applied[point as usize] =
                        super::patch::interpolate(&level.ties[point as usize], &above.total);
                }
            }
        }
    }

    /// Adds the stiffness of a node, a block in N/m, to level 1.
    pub(super) fn stiffen(&mut self, structure: &Structure, node: u32, block: &[f32; 6]) {
        let Some(&entry) = structure.around.row(node).first() else {
            return;
        };
        let (brick, place) = (entry / 32, entry % 32);
        let element = structure.element_of[brick as usize];
        if structure.ties[node as usize].len == 0 {
            return;
        }
        let w = super::element::WEIGHTS[place as usize].map(|w| w as f32);
        self.patches[0].overlay(&structure.levels[0], element, |k| {
            for (p, wp) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
                for (q, wq) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
                    const AT: [[usize; 3]; 3] = [[0, 3, 4], [3, 1, 5], [4, 5, 2]];
                    for a in 0..3 {
                        for b in 0..3 {
                            k[at(p, a)][at(q, b)] += wp * wq * block[AT[a][b]];
                        }
                    }
                }
            }
        });
        let corners = structure.levels[0].corners[element as usize];
        for (c, wc) in w.iter().enumerate().filter(|w| *w.1 > 0.0) {
            self.patches[0].bear(corners[c], block, *wc);
        }
    }

    /// Carries the added stiffness to all levels.
    pub(super) fn spread(&mut self, structure: &Structure) {
        for l in 0..self.patches.len() {
            let level = &structure.levels[l];
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let patch = &mut finer[l];
            for &point in &patch.stiffened.items {
                let p = point as usize;
                let sum = std::array::from_fn(|i| level.bound[p][i] + patch.stiffer[p][i]);
                patch.inverse[p] = invert(&sum);
            }
            let Some(next) = coarser.first_mut() else {
                break;
            };
            for overlay in &patch.overlays {
                let element = overlay.element as usize;
                let octant = level.octant[element] as usize;
                next.overlay(&structure.levels[l + 1], level.parent[element], |k| {
                    add_child(k, &overlay.k, octant);
                });
            }
            for &point in &patch.stiffened.items {
                let ties = &level.ties[point as usize];
                for t in 0..ties.len as usize {
                    next.bear(ties.to[t], &patch.stiffer[point as usize], ties.weight[t]);
                }
            }
        }
    }

    /// Forgets all added stiffness.
    pub(super) fn soften(&mut self, structure: &Structure) {
        for (patch, level) in self.patches.iter_mut().zip(&structure.levels) {
            for overlay in patch.overlays.drain(..) {
                patch.overlay_of[overlay.element as usize] = NONE;
            }
            for &point in &patch.stiffened.items {
                patch.stiffer[point as usize] = [0.0; 6];
                patch.inverse[point as usize] = invert(&level.bound[point as usize]);
            }
            patch.stiffened.clear();
        }
    }
}

impl Patch {
    /// What the correction does to the elements of the set that are not refined.
    #[inline(always)]
    fn defer(&mut self, level: &Level, share: f32, threshold: f32) {
        for i in 0..self.set.items.len() {
            let element = self.set.items[i];
            if self.refined.contains(element) {
                continue;
            }
            let by = Self::corners(level, element, &self.e).map(|v| share * v);
            if self.wait(level, element, &by) > threshold {
                self.wanted.insert(element);
            }
        }
    }

    fn overlay(&mut self, level: &Level, element: u32, add: impl FnOnce(&mut [[f32; SIZE]; SIZE])) {
        debug_assert!((element as usize) < level.corners.len());
        let entry = &mut self.overlay_of[element as usize];
        if *entry == NONE {
            *entry = self.overlays.len() as u32;
            self.overlays.push(Overlay {
                element,
                k: Box::new([[0.0; SIZE]; SIZE]),
            });
        }
        add(&mut self.overlays[*entry as usize].k);
    }

    fn bear(&mut self, point: u32, block: &[f32; 6], weight: f32) {
        self.stiffened.insert(point);
        for (to, v) in self.stiffer[point as usize].iter_mut().zip(block) {
            *to += weight * v;
        }
    }
}

/// Smooths one level. When it was moved by d, the residual is brought up to date first and need
/// not be in the end; when not, the next coarser level wants it.
struct Smooth<'a> {
    level: &'a Level,
    patch: &'a mut Patch,
    steps: usize,
    low: f32,
    moved: bool,
}

impl WithSimd for Smooth<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        if self.moved {
            subtract(self.level, self.patch);
        }
        smooth(self.level, self.patch, self.steps, self.low, !self.moved);
    }
}

/// Defers what a correction does to the elements that are not refined.
struct Defer<'a> {
    level: &'a Level,
    patch: &'a mut Patch,
    share: f32,
    threshold: f32,
}

impl WithSimd for Defer<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        self.patch.defer(self.level, self.share, self.threshold);
    }
}

/// Stiffness along the correction of the elements that are not refined.
struct Curve<'a> {
    level: &'a Level,
    patch: &'a Patch,
}

impl WithSimd for Curve<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> f64 {
        let Self { level, patch } = self;
        let mut sum = 0.0;
        for &element in &patch.set.items {
            if patch.refined.contains(element) {
                continue;
            }
            let x = Patch::corners(level, element, &patch.e);
            let mut y = [0.0; SIZE];
            let m = level.matrix[element as usize] as usize;
            multiply(&level.matrices[m].k, &x, &mut y);
            for i in 0..SIZE {
                sum += f64::from(x[i]) * f64::from(y[i]);
            }
        }
        sum
    }
}

/// `r -= K d` over the set.
#[inline(always)]
fn subtract(level: &Level, patch: &mut Patch) {
    for &element in &patch.set.items {
        let x = Patch::corners(level, element, &patch.d);
        let mut y = [0.0; SIZE];
        let m = level.matrix[element as usize] as usize;
        multiply(&level.matrices[m].k, &x, &mut y);
        let overlay = patch.overlay_of[element as usize];
        if overlay != NONE {
            multiply(&patch.overlays[overlay as usize].k, &x, &mut y);
        }
        for (c, &point) in level.corners[element as usize].iter().enumerate() {
            let r = &mut patch.r[point as usize];
            for a in 0..3 {
                r[a] -= y[at(c, a)];
            }
        }
    }
}

/// Chebyshev steps from the residual in `r`, which is kept up to date to the end if `keep`.
#[inline(always)]
fn smooth(level: &Level, patch: &mut Patch, steps: usize, low: f32, keep: bool) {
    let mut factors = Chebyshev::new(low);
    for step in 1..=steps {
        let (last, new) = factors.next();
        for &point in &patch.points.items {
            let p = point as usize;
            if !patch.free[p] {
                patch.d[p] = ZERO;
                continue;
            }
            let by = apply(&patch.inverse[p], &patch.r[p]);
            for a in 0..3 {
                // On the first step `last` is zero and d still holds something else.
                let before = if last == 0.0 {
                    0.0
                } else {
                    last * patch.d[p][a]
                };
                patch.d[p][a] = before + new * by[a];
                patch.e[p][a] += patch.d[p][a];
            }
        }
        if keep || step < steps {
            subtract(level, patch);
        }
    }
}

fn restrict(ties: &Ties, value: &Quad, to: &mut Patch) {
    for t in 0..ties.len as usize {
        to.load(ties.to[t], value, ties.weight[t]);
    }
}

/// A correction of the coarser level where a point hangs.
#[inline(always)]
pub(super) fn interpolate(ties: &Ties, of: &[Quad]) -> Quad {
    let mut v = ZERO;
    for t in 0..ties.len as usize {
        let from = &of[ties.to[t] as usize];
        for a in 0..3 {
            v[a] += ties.weight[t] * from[a];
        }
    }
    v
}

fn to_child(parent: &Corners, octant: u8) -> Corners {
    let mut child = [0.0; SIZE];
    for c in 0..8 {
        let weights = &super::element::WEIGHTS[super::brick::CORNER[octant as usize][c]];
        for (p, w) in weights.iter().enumerate() {
            for a in 0..3 {
                child[at(c, a)] += *w as f32 * parent[at(p, a)];
            }
        }
    }
    child
}

fn add_child(to: &mut [[f32; SIZE]; SIZE], child: &[[f32; SIZE]; SIZE], octant: usize) {
    let weights: [[f32; 8]; 8] = std::array::from_fn(|c| {
        super::element::WEIGHTS[super::brick::CORNER[octant][c]].map(|w| w as f32)
    });
    let mut t = [[0.0f32; SIZE]; SIZE];
    for (i, row) in t.iter_mut().enumerate() {
        for c in 0..8 {
            for (q, w) in weights[c].iter().enumerate().filter(|w| *w.1 > 0.0) {
                for b in 0..3 {
                    row[at(q, b)] += child[i][at(c, b)] * w;
                }
            }
        }
    }
    for c in 0..8 {
        for (p, w) in weights[c].iter().enumerate().filter(|w| *w.1 > 0.0) {
            for a in 0..3 {
                for j in 0..SIZE {
                    to[at(p, a)][j] += w * t[at(c, a)][j];
                }
            }
        }
    }
}

#[inline(always)]
fn square(v: &Quad) -> f32 {
    v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
}

#[inline(always)]
fn dot(a: &Quad, b: &Quad) -> f64 {
    (0..3).map(|i| f64::from(a[i]) * f64::from(b[i])).sum()
}
