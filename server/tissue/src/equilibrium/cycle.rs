//! One V-cycle over the coarse levels.
//!
//! Each level smooths by Chebyshev iterations, restricts its residual to the coarser level and adds the prolongated
//! correction. The Chebyshev polynomial needs no order of points, so elements are processed in vectors.

use pulp::{Arch, Simd, WithSimd};

use super::coarse_level::{CoarseLevel, Deferred, apply, square, take_over};
use super::element::Matrix;
use super::hierarchy::{Hierarchy, Level};
use super::matrix::Corners;
use super::prolongation::Prolongation;
use super::quad::{Quad, ZERO, plus};

/// Lowest eigenvalue that the smoother damps, relative to the bound of all eigenvalues.
pub(super) const LOW: f32 = 0.15;
/// The same on the coarsest level.
const LOW_COARSEST: f32 = 0.02;
/// Work of a V-cycle.
#[derive(Clone, Copy)]
pub(super) struct Effort {
    /// Smoothing steps on each level before and after the coarse correction.
    pub(super) before: usize,
    pub(super) after: usize,
    /// Steps on the coarsest level, in place of a direct solve.
    pub(super) coarsest: usize,
    /// Load in thresholds that activates a point outside the set.
    pub(super) loaded: f32,
}

/// Coefficients of a Chebyshev iteration on [low, 1] times the bound.
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
    pub(super) patches: Vec<CoarseLevel>,
    arch: Arch,
    /// Force on a corner of an element of level 1, in thresholds, above which it is refined.
    pub(super) pending: f32,
    /// Relative change of size up to which an element stays deferred.
    pub(super) strained: f32,
    /// Stiffness of deferred elements relative to their matrix (inhomogeneous, homogeneous): a trilinear element is
    /// stiffer than the tissue in it.
    pub(super) slack: [f32; 2],
    /// Work of the correction on all deferred elements, eᵀKe, in N m.
    curve: f64,
    /// Elements visited.
    pub(super) visits: usize,
    /// Whether a point that becomes active counts its earlier moves with the coarser level as its own. Only without
    /// tools: under tools the warm start carries local changes, and forces came out worse.
    pub(super) follows: bool,
    /// Whether the outer forces have been restricted for the current sets and are unchanged.
    pub(super) is_beyond_restricted: bool,
}

impl Multigrid {
    pub(super) fn new(structure: &Hierarchy) -> Self {
        Self {
            patches: structure.levels.iter().map(CoarseLevel::new).collect(),
            arch: Arch::new(),
            pending: 1.0,
            strained: f32::INFINITY,
            slack: [1.0; 2],
            curve: 0.0,
            visits: 0,
            follows: false,
            is_beyond_restricted: false,
        }
    }

    /// Limits of a deferred element of level l + 1: a force in N (coarse errors are a smaller part of a larger force)
    /// and a change of size in m (coarse matrices do not know that tissue stiffens).
    fn tolerable(&self, structure: &Hierarchy, l: usize, threshold: f32) -> [f32; 2] {
        let side = (2 << l) as f32 / structure.per_spacing;
        [
            self.pending * threshold * (1 << l) as f32,
            self.strained * side,
        ]
    }

    /// Chooses the active elements of every level around the refined elements of level 1; `more` extends the earlier
    /// choice.
    pub(super) fn select(&mut self, structure: &Hierarchy, more: bool) {
        self.is_beyond_restricted = false;
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
            // One ring around the refined elements, so that all their points are free.
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
        for patch in &mut self.patches {
            for &element in &patch.refined.items {
                patch.stirred.insert(element);
            }
        }
    }

    /// Refines again all elements that the last step refined. Returns whether that adds any.
    pub(super) fn stir(&mut self, structure: &Hierarchy) -> bool {
        let mut more = false;
        for patch in &mut self.patches {
            for i in 0..patch.stirred.items.len() {
                more |= patch.refined.insert(patch.stirred.items[i]);
            }
            patch.refined.sort();
        }
        if more {
            self.select(structure, true);
        }
        more
    }

    /// Marks the next element of level 1 with a large deferred force, and its neighbours, for refinement: nodes are
    /// free only where all elements around them are refined. Elements with at least half of the largest force take
    /// turns (block Gauss-Seidel).
    pub(super) fn refine_next(&mut self, structure: &Hierarchy) {
        let (level, patch) = (&structure.levels[0], &mut self.patches[0]);
        let Some(element) = patch.next_deferred() else {
            return;
        };
        for point in level.corners[element as usize] {
            for &other in level.around.row(point) {
                if !patch.refined.contains(other) {
                    patch.wanted.insert(other);
                }
            }
        }
    }

    /// Clears the record of elements refined in the last step.
    pub(super) fn calm(&mut self) {
        for patch in &mut self.patches {
            patch.stirred.clear();
        }
    }

    /// Prolongates pending displacements to the refined elements. Returns whether more elements exceed their limits.
    pub(super) fn push(&mut self, structure: &Hierarchy, threshold: f32) -> bool {
        for l in (0..self.patches.len()).rev() {
            take_over(structure, &mut self.patches, l);
        }
        for l in (1..self.patches.len()).rev() {
            let tolerable = self.tolerable(structure, l - 1, threshold);
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
                    let force = level_below.force(child, &by);
                    let slack = self.slack[usize::from(level_below.element(child).1.even)];
                    let force = force.map(|f| f.map(|v| slack * v));
                    let waits = below.wait(level_below, child, &by, &force, 1.0);
                    if exceeds(waits, tolerable) && !below.refined.contains(child) {
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
    pub(super) fn cycle(&mut self, structure: &Hierarchy, threshold: f32, effort: Effort) {
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
                restrict(&level.prolongation, point, &patch.r[point as usize], next);
            }
            for &point in &patch.loaded.items {
                if patch.inside[point as usize] == 0 {
                    let b = patch.b[point as usize];
                    restrict(&level.prolongation, point, &b, next);
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
                let p = point as usize;
                let v = level.prolongation.interpolate(p, &above.e);
                patch.d[p] = v;
                patch.e[p] = plus(&patch.e[p], 1.0, &v);
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

    /// Whether the totals changed in this step are below `limit` m.
    pub(super) fn is_within(&self, limit: f64) -> bool {
        self.patches.iter().all(|patch| {
            let mut totals = patch.gained.items.iter().map(|&p| patch.total[p as usize]);
            totals.all(|total| crate::Vec3::from(total).norm() < limit)
        })
    }

    /// Starts a step: the accumulated correction of the last step becomes the candidate for the warm start. Rim points
    /// follow the coarser level, or deferred elements beside them would miss their moves.
    pub(super) fn recall(&mut self, structure: &Hierarchy) {
        for l in (0..self.patches.len()).rev() {
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let (patch, above) = (&mut finer[l], coarser.first());
            for &point in &patch.points.items {
                let p = point as usize;
                let gained = patch.gained.contains(point);
                patch.e[p] = match above {
                    Some(above) if !patch.free[p] => {
                        structure.levels[l].prolongation.interpolate(p, &above.e)
                    }
                    _ if gained => patch.gain[p],
                    _ => ZERO,
                };
            }
            patch.gained.clear();
        }
    }

    /// Computes the forces of the correction on elements that are not refined, for `work_along` and `commit`.
    pub(super) fn defer(&mut self, structure: &Hierarchy) {
        self.curve = 0.0;
        let slack = self.slack;
        for (patch, level) in self.patches.iter_mut().zip(&structure.levels) {
            let defer = Defer {
                level,
                patch,
                slack,
                curve: &mut self.curve,
            };
            self.arch.dispatch(defer);
        }
    }

    /// Work of the deferred residual of the sets along the correction, at its start and its end, in N m.
    pub(super) fn work_along(&self) -> [f64; 2] {
        let mut before = 0.0;
        for patch in &self.patches {
            for &point in &patch.lagging.items {
                let p = point as usize;
                if patch.inside[p] > 0 {
                    before += dot(&patch.lag[p], &patch.e[p]);
                }
            }
        }
        [before, before - self.curve]
    }

    /// Applies `share` of the correction: displacements in full, forces of unrefined elements as deferred residual.
    /// Marks the elements to refine next.
    pub(super) fn commit(&mut self, structure: &Hierarchy, share: f32, threshold: f32) {
        for l in (0..self.patches.len()).rev() {
            let level = &structure.levels[l];
            let tolerable = self.tolerable(structure, l, threshold);
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            let patch = &mut finer[l];
            for &point in &patch.points.items {
                let p = point as usize;
                if patch.gained.insert(point) {
                    let above = coarser.first().filter(|_| self.follows);
                    patch.gain[p] = above.map_or(ZERO, |above| {
                        let e = level.prolongation.interpolate(p, &above.e);
                        let gain = level.prolongation.interpolate(p, &above.gain);
                        plus(&gain, -share, &e)
                    });
                }
                for a in 0..3 {
                    patch.total[p][a] += f64::from(share) * f64::from(patch.e[p][a]);
                }
                patch.gain[p] = plus(&patch.gain[p], share, &patch.e[p]);
            }
            let mut deferred = std::mem::take(&mut patch.deferred);
            for Deferred { element, force } in deferred.drain(..) {
                let by = level.corners[element as usize].map(|p| patch.e[p as usize]);
                if exceeds(patch.wait(level, element, &by, &force, share), tolerable) {
                    patch.wanted.insert(element);
                }
            }
            patch.deferred = deferred;
            // The correction `e` includes that of the coarser level, so it counts as applied.
            let (finer, coarser) = self.patches.split_at_mut(l + 1);
            if let Some(above) = coarser.first() {
                let patch = &mut finer[l];
                for &point in &patch.points.items {
                    let p = point as usize;
                    patch.applied[p] = level.prolongation.interpolate_exactly(p, &above.total);
                }
            }
        }
    }
}

/// Smooths one level. If level was moved by d, the residual is updated first and not at the end; if not, the coarser
/// level needs the final residual.
struct Smooth<'a> {
    level: &'a Level,
    patch: &'a mut CoarseLevel,
    steps: usize,
    low: f32,
    moved: bool,
}

impl WithSimd for Smooth<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if self.moved {
            subtract(simd, self.level, self.patch);
        }
        smooth(
            simd,
            self.level,
            self.patch,
            self.steps,
            self.low,
            !self.moved,
        );
    }
}

/// Computes the forces of the correction on unrefined elements.
struct Defer<'a> {
    level: &'a Level,
    patch: &'a mut CoarseLevel,
    slack: [f32; 2],
    curve: &'a mut f64,
}

impl WithSimd for Defer<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            level,
            patch,
            slack,
            curve,
        } = self;
        patch.deferred.clear();
        for &element in &patch.set.items {
            if patch.refined.contains(element) {
                continue;
            }
            let (points, m) = level.element(element);
            let force = m.k.multiply(simd, points, &patch.e).corners();
            let slack = slack[usize::from(m.even)];
            let force = force.map(|f| f.map(|v| slack * v));
            for (&point, force) in points.iter().zip(&force) {
                *curve += dot(&patch.e[point as usize], force);
            }
            patch.deferred.push(Deferred { element, force });
        }
    }
}

impl Level {
    /// Forces of an element for these corner displacements, in N.
    fn force(&self, element: u32, by: &Corners) -> Corners {
        let (_, m) = self.element(element);
        m.k.multiply(pulp::Scalar::new(), &[0, 1, 2, 3, 4, 5, 6, 7], by)
            .corners()
    }

    /// Points and matrix of an element.
    #[inline(always)]
    pub(super) fn element(&self, element: u32) -> (&[u32; 8], &Matrix) {
        let e = element as usize;
        (&self.corners[e], &self.matrices[self.matrix[e] as usize])
    }
}

/// `r -= K d` over the set.
#[inline(always)]
fn subtract<S: Simd>(simd: S, level: &Level, patch: &mut CoarseLevel) {
    for &element in &patch.set.items {
        let (points, m) = level.element(element);
        let overlay = patch.overlay_of[element as usize];
        let y = match patch.overlays.get(overlay as usize) {
            Some(overlay) => overlay.k.multiply(simd, points, &patch.d),
            None => m.k.multiply(simd, points, &patch.d),
        };
        for (c, &point) in points.iter().enumerate() {
            let r = &mut patch.r[point as usize];
            *r = plus(r, -1.0, &y.corner(c));
        }
    }
}

/// Chebyshev steps from the residual in `r`; `keep` updates it after the last step too.
#[inline(always)]
fn smooth<S: Simd>(
    simd: S,
    level: &Level,
    patch: &mut CoarseLevel,
    steps: usize,
    low: f32,
    keep: bool,
) {
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
            // In the first step `last` is zero and d is stale.
            let before = if last == 0.0 { ZERO } else { patch.d[p] };
            let d = plus(&by.map(|v| new * v), last, &before);
            patch.d[p] = d;
            patch.e[p] = plus(&patch.e[p], 1.0, &d);
        }
        if keep || step < steps {
            subtract(simd, level, patch);
        }
    }
}

fn exceeds(waits: [f32; 2], tolerable: [f32; 2]) -> bool {
    waits[0] > tolerable[0] || waits[1] > tolerable[1]
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
