//! One V-cycle over the coarse levels.
//!
//! Each level smooths by Chebyshev iterations, restricts its residual to the coarser level and adds the prolongated
//! correction. The Chebyshev polynomial needs no order of points, so elements are processed in vectors.

use pulp::{Arch, Simd, WithSimd};

use super::coarse_level::{CoarseLevel, Deferred, apply, follow_coarser};
use super::hierarchy::{Hierarchy, Level};
use super::matrix::Corners;
use super::matrix::Matrix;
use super::prolongation::Prolongation;
use super::quad::{Quad, ZERO, plus, square};

/// Lowest eigenvalue that is damped on the coarsest level.
const LOW_COARSEST: f32 = 0.02;
/// Smoothing steps on each level before and after the coarse correction.
const STEPS: usize = 3;
/// Steps on the coarsest level, in place of a direct solve.
const STEPS_COARSEST: usize = 10;

/// Coefficients of a Chebyshev iteration on [low, 1] times the bound.
pub(super) struct Chebyshev {
    theta: f32,
    delta: f32,
    rho: f32,
}

impl Chebyshev {
    pub(super) fn new(low: f32, bound: f32) -> Self {
        let (theta, delta) = (0.5 * bound * (1.0 + low), 0.5 * bound * (1.0 - low));
        Self {
            theta,
            delta,
            rho: 0.0,
        }
    }

    /// Coefficients of the previous update and of the preconditioned residual.
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

/// The coarse levels of one shape.
pub(super) struct Multigrid {
    pub(super) grids: Vec<CoarseLevel>,
    arch: Arch,
    /// Force on a corner of an element of level 1, in thresholds, above which it is refined; infinite in quick steps.
    pub(super) pending: f32,
    /// Relative change of size up to which an element stays deferred.
    pub(super) strained: f32,
    /// Whether deferred elements answer with their effective stiffness, instead of their matrix.
    pub(super) is_effective: bool,
    /// Work of the correction on all deferred elements, eᵀKe, in N m.
    curve: f64,
    /// Elements visited.
    pub(super) visits: usize,
    /// Whether a point that becomes active counts its earlier moves with the coarser level as its own. Only without
    /// tools: under tools the warm start carries local changes, and forces came out worse.
    pub(super) follows: bool,
    /// Whether the outer forces have been restricted for the current sets and are unchanged.
    pub(super) is_outer_restricted: bool,
}

impl Multigrid {
    pub(super) fn new(hierarchy: &Hierarchy) -> Self {
        Self {
            grids: hierarchy.levels.iter().map(CoarseLevel::new).collect(),
            arch: Arch::new(),
            pending: f32::INFINITY,
            strained: f32::INFINITY,
            is_effective: false,
            curve: 0.0,
            visits: 0,
            follows: false,
            is_outer_restricted: false,
        }
    }

    /// Chooses the active elements of every level around the refined elements of level 1; `more` extends the earlier
    /// choice.
    pub(super) fn select(&mut self, hierarchy: &Hierarchy, more: bool) {
        self.is_outer_restricted = false;
        let last = self.grids.len() - 1;
        for l in 0..last {
            let level = &hierarchy.levels[l];
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let (grid, above) = (&finer[l], &mut coarser[0]);
            if !more {
                above.refined.clear();
            }
            for element in above.to_refine.take() {
                above.refined.insert(element);
            }
            // One ring around the refined elements, so that all their points are free.
            for &element in &grid.refined.items {
                for point in level.corners[element as usize] {
                    for &other in level.around.row(point) {
                        above.refined.insert(level.parent[other as usize]);
                    }
                }
            }
            above.refined.sort();
        }
        for l in (0..=last).rev() {
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let above = coarser
                .first()
                .map(|p| (&hierarchy.levels[l + 1], &p.refined));
            finer[l].choose(&hierarchy.levels[l], above);
        }
    }

    /// Marks the next element of level 1 with a large deferred force, and its neighbours, for refinement: nodes are
    /// free only where all elements around them are refined. Elements with at least half of the largest force take
    /// turns (block Gauss-Seidel).
    pub(super) fn refine_next(&mut self, hierarchy: &Hierarchy) {
        let (level, grid) = (&hierarchy.levels[0], &mut self.grids[0]);
        let Some(element) = grid.next_deferred() else {
            return;
        };
        for point in level.corners[element as usize] {
            for &other in level.around.row(point) {
                if !grid.refined.contains(other) {
                    grid.to_refine.insert(other);
                }
            }
        }
    }

    /// Prolongates pending displacements to the refined elements. Returns whether more elements exceed their limits.
    pub(super) fn prolongate_pending(&mut self, hierarchy: &Hierarchy, threshold: f32) -> bool {
        for l in (0..self.grids.len()).rev() {
            follow_coarser(hierarchy, &mut self.grids, l);
        }
        for l in (0..self.grids.len()).rev() {
            for i in 0..self.grids[l].refined.items.len() {
                let element = self.grids[l].refined.items[i];
                if self.grids[l].has_pending[element as usize] {
                    self.release(hierarchy, l, element, threshold);
                }
            }
            self.grids[l].trim();
        }
        self.grids.iter().any(|p| !p.to_refine.items.is_empty())
    }

    /// Passes the pending displacement of an element on to its children, and marks those that exceed their limits for
    /// refinement. The bricks of an element of level 1 must be computed afterwards.
    pub(super) fn release(
        &mut self,
        hierarchy: &Hierarchy,
        l: usize,
        element: u32,
        threshold: f32,
    ) {
        let level = &hierarchy.levels[l];
        let (finer, coarser) = self.grids.split_at_mut(l);
        let pending = coarser[0].take_pending(level, element);
        let Some(below) = finer.last_mut() else {
            return;
        };
        let level_below = &hierarchy.levels[l - 1];
        for &child in level.children.row(element) {
            let by = to_child(&pending, level_below.octant[child as usize]);
            let secant = self.is_effective.then(|| below.secant[child as usize]);
            let force = level_below.force(pulp::Scalar::new(), child, &by, secant);
            let waits = below.defer_displacement(level_below, child, &by, &force, 1.0);
            let limits =
                deferral_limits(hierarchy, l - 1, [self.pending * threshold, self.strained]);
            if exceeds(waits, limits) && !below.refined.contains(child) {
                below.to_refine.insert(child);
            }
        }
    }

    /// One V-cycle for the loads on level 1; leaves the correction in the `e` of every level. `smooths_before` tells
    /// whether levels are also smoothed before the coarse correction.
    pub(super) fn cycle(&mut self, hierarchy: &Hierarchy, smooths_before: bool) {
        let last = self.grids.len() - 1;
        let low = hierarchy.smoothing.low;
        for l in 0..=last {
            let level = &hierarchy.levels[l];
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let grid = &mut finer[l];
            for i in 0..grid.deferred_points.items.len() {
                let point = grid.deferred_points.items[i];
                let lag = grid.deferred_residual[point as usize];
                grid.load(point, &lag, 1.0);
            }
            for &point in &grid.points.items {
                let p = point as usize;
                grid.e[p] = ZERO;
                grid.r[p] = if grid.loaded.contains(point) {
                    grid.b[p]
                } else {
                    ZERO
                };
            }
            let (steps, low) = if l == last {
                (STEPS_COARSEST, LOW_COARSEST)
            } else {
                (if smooths_before { STEPS } else { 0 }, low)
            };
            self.visits += (1 + steps) * grid.set.items.len();
            self.arch.dispatch(Smooth {
                level,
                grid,
                steps,
                low,
                moved: false,
            });
            let Some(next) = coarser.first_mut() else {
                continue;
            };
            for &point in &grid.points.items {
                restrict(&level.prolongation, point, &grid.r[point as usize], next);
            }
            for &point in &grid.loaded.items {
                if grid.inside[point as usize] == 0 {
                    let b = grid.b[point as usize];
                    restrict(&level.prolongation, point, &b, next);
                }
            }
        }
        for l in (0..last).rev() {
            let level = &hierarchy.levels[l];
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let (grid, above) = (&mut finer[l], &coarser[0]);
            for &point in &grid.points.items {
                let p = point as usize;
                let v = level.prolongation.interpolate(p, &above.e);
                grid.d[p] = v;
                grid.e[p] = plus(&grid.e[p], 1.0, &v);
            }
            self.visits += STEPS * grid.set.items.len();
            self.arch.dispatch(Smooth {
                level,
                grid,
                steps: STEPS,
                low,
                moved: true,
            });
        }
        for grid in &mut self.grids {
            grid.loaded.clear();
        }
    }

    /// Shortens the correction of every level to `reach` m at each point. Rim points still follow the coarser level.
    pub(super) fn limit_corrections(&mut self, hierarchy: &Hierarchy, reach: f32) {
        let mut is_shortened = false;
        for l in (0..self.grids.len()).rev() {
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let (grid, above) = (&mut finer[l], coarser.first());
            for &point in &grid.points.items {
                let p = point as usize;
                if let Some(above) = above.filter(|_| !grid.free[p]) {
                    if is_shortened {
                        let prolongation = &hierarchy.levels[l].prolongation;
                        grid.e[p] = prolongation.interpolate(p, &above.e);
                    }
                    continue;
                }
                let e = &mut grid.e[p];
                let length = square(e).sqrt();
                if length > reach {
                    *e = e.map(|v| v * (reach / length));
                    is_shortened = true;
                }
            }
        }
    }

    /// Whether the totals changed in this step are below `limit` m.
    pub(super) fn is_within(&self, limit: f64) -> bool {
        self.grids.iter().all(|grid| {
            let mut totals = grid.corrected.items.iter().map(|&p| grid.total[p as usize]);
            totals.all(|total| crate::Vec3::from(total).norm() < limit)
        })
    }

    /// Starts a step: the accumulated correction of the last step becomes the candidate for the warm start. Rim points
    /// follow the coarser level, or deferred elements beside them would miss their moves.
    pub(super) fn load_last_correction(&mut self, hierarchy: &Hierarchy, rim: bool) {
        for l in (0..self.grids.len()).rev() {
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let (grid, above) = (&mut finer[l], coarser.first());
            for &point in &grid.points.items {
                let p = point as usize;
                let corrected = grid.corrected.contains(point);
                grid.e[p] = match above {
                    Some(above) if rim && !grid.free[p] => {
                        hierarchy.levels[l].prolongation.interpolate(p, &above.e)
                    }
                    _ if corrected => grid.step_correction[p],
                    _ => ZERO,
                };
            }
            grid.corrected.clear();
        }
    }

    /// Computes the forces of the correction on elements that are not refined, for `work_along` and `commit`.
    pub(super) fn defer(&mut self, hierarchy: &Hierarchy) {
        self.curve = 0.0;
        let is_effective = self.is_effective;
        for (grid, level) in self.grids.iter_mut().zip(&hierarchy.levels) {
            let defer = Defer {
                level,
                grid,
                is_effective,
                curve: &mut self.curve,
            };
            self.arch.dispatch(defer);
        }
    }

    /// Work of the deferred residual of the sets along the correction, at its start and its end, in N m.
    pub(super) fn work_along(&self) -> [f64; 2] {
        let mut before = 0.0;
        for grid in &self.grids {
            for &point in &grid.deferred_points.items {
                let p = point as usize;
                if grid.inside[p] > 0 {
                    before += dot(&grid.deferred_residual[p], &grid.e[p]);
                }
            }
        }
        [before, before - self.curve]
    }

    /// Applies `share` of the correction: displacements in full, forces of unrefined elements as deferred residual.
    /// Marks the elements to refine next.
    pub(super) fn commit(&mut self, hierarchy: &Hierarchy, share: f32, threshold: f32) {
        for l in (0..self.grids.len()).rev() {
            let level = &hierarchy.levels[l];
            let limits = deferral_limits(hierarchy, l, [self.pending * threshold, self.strained]);
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            let grid = &mut finer[l];
            for &point in &grid.points.items {
                let p = point as usize;
                if grid.corrected.insert(point) {
                    let above = coarser.first().filter(|_| self.follows);
                    grid.step_correction[p] = above.map_or(ZERO, |above| {
                        let e = level.prolongation.interpolate(p, &above.e);
                        let gain = level.prolongation.interpolate(p, &above.step_correction);
                        plus(&gain, -share, &e)
                    });
                }
                for a in 0..3 {
                    grid.total[p][a] += f64::from(share) * f64::from(grid.e[p][a]);
                }
                grid.step_correction[p] = plus(&grid.step_correction[p], share, &grid.e[p]);
            }
            let mut deferred = std::mem::take(&mut grid.deferred);
            for Deferred { element, force } in deferred.drain(..) {
                let by = level.corners[element as usize].map(|p| grid.e[p as usize]);
                if exceeds(
                    grid.defer_displacement(level, element, &by, &force, share),
                    limits,
                ) {
                    grid.to_refine.insert(element);
                }
            }
            grid.deferred = deferred;
            // The correction `e` includes that of the coarser level, so it counts as applied.
            let (finer, coarser) = self.grids.split_at_mut(l + 1);
            if let Some(above) = coarser.first() {
                let grid = &mut finer[l];
                for &point in &grid.points.items {
                    let p = point as usize;
                    grid.applied[p] = level.prolongation.interpolate_exactly(p, &above.total);
                }
            }
        }
    }
}

/// Smooths one level. If the level was moved by d, the residual is updated first and not at the end; if not, the coarser
/// level needs the final residual.
struct Smooth<'a> {
    level: &'a Level,
    grid: &'a mut CoarseLevel,
    steps: usize,
    low: f32,
    moved: bool,
}

impl WithSimd for Smooth<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if self.moved {
            subtract(simd, self.level, self.grid);
        }
        smooth(
            simd,
            self.level,
            self.grid,
            self.steps,
            self.low,
            !self.moved,
        );
    }
}

/// Computes the forces of the correction on unrefined elements.
struct Defer<'a> {
    level: &'a Level,
    grid: &'a mut CoarseLevel,
    is_effective: bool,
    curve: &'a mut f64,
}

impl WithSimd for Defer<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            level,
            grid,
            is_effective,
            curve,
        } = self;
        grid.deferred.clear();
        for &element in &grid.set.items {
            if grid.refined.contains(element) {
                continue;
            }
            let mut by = [ZERO; 8];
            for (v, &point) in by.iter_mut().zip(&level.corners[element as usize]) {
                *v = grid.e[point as usize];
            }
            let secant = is_effective.then(|| grid.secant[element as usize]);
            let force = level.force(simd, element, &by, secant);
            for (v, force) in by.iter().zip(&force) {
                *curve += dot(v, force);
            }
            grid.deferred.push(Deferred { element, force });
        }
    }
}

impl Level {
    /// Forces of an element for these corner displacements, in N, by `secant` times its effective stiffness, or by its
    /// matrix.
    #[inline(always)]
    pub(super) fn force<S: Simd>(
        &self,
        simd: S,
        element: u32,
        by: &Corners,
        secant: Option<f32>,
    ) -> Corners {
        let stiffness = &self.matrices[self.matrix[element as usize] as usize];
        match secant {
            Some(secant) => stiffness.effective_force(simd, secant, by),
            None => stiffness
                .matrix
                .multiply(simd, &[0, 1, 2, 3, 4, 5, 6, 7], by)
                .corners(),
        }
    }

    /// Points and matrix of an element.
    #[inline(always)]
    pub(super) fn element(&self, element: u32) -> (&[u32; 8], &Matrix) {
        let e = element as usize;
        (
            &self.corners[e],
            &self.matrices[self.matrix[e] as usize].matrix,
        )
    }
}

/// `r -= K d` over the set.
#[inline(always)]
fn subtract<S: Simd>(simd: S, level: &Level, grid: &mut CoarseLevel) {
    for &element in &grid.set.items {
        let (points, m) = level.element(element);
        let stiffened = grid.stiffness_of[element as usize];
        let y = match grid.stiffened_elements.get(stiffened as usize) {
            Some(stiffened) => stiffened.k.multiply(simd, points, &grid.d),
            None => m.multiply(simd, points, &grid.d),
        };
        for (c, &point) in points.iter().enumerate() {
            let r = &mut grid.r[point as usize];
            *r = plus(r, -1.0, &y.corner(c));
        }
    }
}

/// Chebyshev steps from the residual in `r`; `keep` updates it after the last step too.
#[inline(always)]
fn smooth<S: Simd>(
    simd: S,
    level: &Level,
    grid: &mut CoarseLevel,
    steps: usize,
    low: f32,
    keep: bool,
) {
    let mut factors = Chebyshev::new(low, 1.0);
    for step in 1..=steps {
        let (last, new) = factors.next();
        for &point in &grid.points.items {
            let p = point as usize;
            if !grid.free[p] {
                grid.d[p] = ZERO;
                continue;
            }
            let by = apply(&grid.inverse[p], &grid.r[p]);
            // In the first step `last` is zero and d is stale.
            let before = if last == 0.0 { ZERO } else { grid.d[p] };
            let d = plus(&by.map(|v| new * v), last, &before);
            grid.d[p] = d;
            grid.e[p] = plus(&grid.e[p], 1.0, &d);
        }
        if keep || step < steps {
            subtract(simd, level, grid);
        }
    }
}

/// Limits of a deferred element of level l + 1: a force in N (coarse errors are a smaller part of a larger force) in full
/// solves, and a change of size in m (coarse matrices do not know that tissue stiffens) in quick steps. They follow from
/// those of level 1 and from the side.
fn deferral_limits(hierarchy: &Hierarchy, l: usize, [force, strain]: [f32; 2]) -> [f32; 2] {
    let side = (2 << l) as f32 / hierarchy.per_spacing;
    [force * (1 << l) as f32, strain * side]
}

fn exceeds(waits: [f32; 2], limits: [f32; 2]) -> bool {
    waits[0] > limits[0] || waits[1] > limits[1]
}

/// Adds the restricted force of a point to the loads of the coarser level.
#[inline(always)]
pub(super) fn restrict(by: &Prolongation, point: u32, force: &Quad, to: &mut CoarseLevel) {
    for (coarse, weight) in by.row(point as usize) {
        to.load(coarse, force, weight);
    }
}

fn to_child(parent: &Corners, octant: u8) -> Corners {
    let mut child = [ZERO; 8];
    for (c, to) in child.iter_mut().enumerate() {
        let weights = &super::element::WEIGHTS[super::brick::CORNER[octant as usize][c]];
        for (from, w) in parent.iter().zip(weights) {
            *to = plus(to, *w as f32, from);
        }
    }
    child
}

#[inline(always)]
fn dot(a: &Quad, b: &Quad) -> f64 {
    (0..3).map(|i| f64::from(a[i]) * f64::from(b[i])).sum()
}
