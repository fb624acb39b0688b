//! The active part of each coarse lattice, and the deferred residual outside it.
//!
//! The levels are refined around the tools only (a fast adaptive composite grid). On level l an *active set* of
//! elements is solved. Some of them are *refined*: their children on the finer level are active instead. Points whose
//! elements are all active are free; points on the rim follow the coarser level.
//!
//! An element that is active but not refined answers a correction by its matrix only. Its *pending* displacement p adds
//! the force -K p to the deferred residual g of its points. When the element is refined, its children (at last the
//! bricks, which are then recomputed) receive p, and K p is removed from g. Displacements are deferred likewise: every
//! point keeps its total and the part of the coarser level's total that it has already received (`applied`).

use super::hierarchy::{Hierarchy, Level};
use super::matrix::{Columns, Corners};
use super::quad::{Quad, ZERO, laid_out, move_to_room, plus, square, trim};

/// Stiffness of an element including contacts and held nodes.
pub(super) struct ContactStiffness {
    pub(super) element: u32,
    pub(super) k: Box<Columns>,
}

/// Force of a correction on an element that is not refined.
pub(super) struct Deferred {
    pub(super) element: u32,
    /// K e at the corners, in N.
    pub(super) force: Corners,
}

/// Fraction of all indices from which on a list is sorted by scanning the membership flags.
const FEW: usize = 16;

/// A set of indices; clearing costs only the number of its items.
#[derive(Default)]
pub(super) struct List {
    pub(super) items: Vec<u32>,
    member: Vec<bool>,
}

impl List {
    pub(super) fn new(len: usize) -> Self {
        Self {
            items: Vec::with_capacity(len),
            member: laid_out(false, len),
        }
    }

    /// Takes indices below `len` from now on.
    pub(super) fn grow(&mut self, len: usize) {
        self.member.resize(len, false);
    }

    /// Drops the items from `len` on.
    pub(super) fn shrink(&mut self, len: usize) {
        if len < self.member.len() {
            self.items.retain(|&item| (item as usize) < len);
            let items = self.items.len();
            move_to_room(&mut self.items, items.max(len));
            trim(&mut self.member, len);
        }
    }

    #[inline]
    pub(super) fn insert(&mut self, item: u32) -> bool {
        let member = &mut self.member[item as usize];
        let new = !*member;
        if new {
            *member = true;
            self.items.push(item);
        }
        new
    }

    #[inline]
    pub(super) fn contains(&self, item: u32) -> bool {
        self.member[item as usize]
    }

    pub(super) fn clear(&mut self) {
        for item in self.items.drain(..) {
            self.member[item as usize] = false;
        }
    }

    /// Removes and returns all items.
    pub(super) fn take(&mut self) -> Vec<u32> {
        let items = std::mem::take(&mut self.items);
        for &item in &items {
            self.member[item as usize] = false;
        }
        items
    }

    pub(super) fn sort(&mut self) {
        if self.items.is_sorted() {
            return;
        }
        if self.items.len() < self.member.len() / FEW {
            self.items.sort_unstable();
        } else {
            self.items.clear();
            let all = 0..self.member.len() as u32;
            self.items.extend(all.filter(|&i| self.member[i as usize]));
        }
    }

    /// Keeps the items for which `keep` holds, in order.
    pub(super) fn retain(&mut self, mut keep: impl FnMut(u32) -> bool) {
        let member = &mut self.member;
        self.items.retain(|&item| {
            let stays = keep(item);
            member[item as usize] = stays;
            stays
        });
    }
}

/// The state of one coarse level.
pub(super) struct CoarseLevel {
    pub(super) set: List,
    pub(super) refined: List,
    /// Elements to be refined in the next cycle.
    pub(super) to_refine: List,
    /// Active points, and the number of active elements around each.
    pub(super) points: List,
    pub(super) inside: Vec<u32>,
    pub(super) free: Vec<bool>,

    pub(super) e: Vec<Quad>,
    pub(super) d: Vec<Quad>,
    pub(super) b: Vec<Quad>,
    pub(super) r: Vec<Quad>,
    /// Points with a load, active or not.
    pub(super) loaded: List,

    /// Accumulated correction of this step, and its points.
    pub(super) step_correction: Vec<Quad>,
    pub(super) corrected: List,

    /// Forces in N restricted from outside the finer level's active set, and their points.
    pub(super) outer_force: Vec<Quad>,
    pub(super) outer_points: List,

    pub(super) deferred_residual: Vec<Quad>,
    pub(super) deferred_points: List,
    pub(super) pending: Vec<Corners>,
    /// K p of each element: its part of the deferred residual.
    pub(super) deferred_force: Vec<Corners>,
    pub(super) has_pending: Vec<bool>,
    /// Square of the largest corner force of each element's pending displacement, in N².
    deferred_square: Vec<f32>,
    /// Stiffness of each element along its displacement when it was last refined, relative to its effective stiffness; 1
    /// on levels above 1.
    pub(super) secant: Vec<f32>,
    /// The element that was refined last by rotation.
    last_turn: u32,
    /// Forces of the correction `e` on active elements that are not refined.
    pub(super) deferred: Vec<Deferred>,
    pub(super) total: Vec<[f64; 3]>,
    /// Whether the totals count from the reference state.
    pub(super) starts_at_reference: bool,
    pub(super) applied: Vec<[f64; 3]>,
    /// Totals that were already prolongated to the whole finer level.
    prolongated: Vec<[f64; 3]>,

    pub(super) stiffened_elements: Vec<ContactStiffness>,
    /// Unused entries for reuse.
    pub(super) spare: Vec<ContactStiffness>,
    pub(super) stiffness_of: Vec<u32>,
    /// Additional diagonal bound of points by contact stiffness, and these points.
    pub(super) added_bound: Vec<[f32; 6]>,
    pub(super) stiffened: List,
    pub(super) inverse: Vec<[f32; 6]>,
}

const NOTHING: Corners = [ZERO; 8];
/// No contact stiffness.
pub(super) const NONE: u32 = u32::MAX;

impl CoarseLevel {
    pub(super) fn new(level: &Level) -> Self {
        let (elements, points) = (level.corners.len(), level.points());
        Self {
            set: List::new(elements),
            refined: List::new(elements),
            to_refine: List::new(elements),
            points: List::new(points),
            inside: laid_out(0, points),
            free: laid_out(false, points),
            e: laid_out(ZERO, points),
            d: laid_out(ZERO, points),
            b: laid_out(ZERO, points),
            r: laid_out(ZERO, points),
            loaded: List::new(points),
            step_correction: laid_out(ZERO, points),
            corrected: List::new(points),
            outer_force: laid_out(ZERO, points),
            outer_points: List::new(points),
            deferred_residual: laid_out(ZERO, points),
            deferred_points: List::new(points),
            pending: laid_out(NOTHING, elements),
            deferred_force: laid_out(NOTHING, elements),
            has_pending: laid_out(false, elements),
            deferred_square: laid_out(0.0, elements),
            secant: laid_out(1.0, elements),
            last_turn: 0,
            deferred: Vec::new(),
            total: laid_out([0.0; 3], points),
            starts_at_reference: true,
            applied: laid_out([0.0; 3], points),
            prolongated: Vec::new(),
            stiffened_elements: Vec::new(),
            spare: Vec::new(),
            stiffness_of: laid_out(NONE, elements),
            added_bound: laid_out([0.0; 6], points),
            stiffened: List::new(points),
            inverse: level.bound.iter().map(invert).collect(),
        }
    }

    /// Resets displacements and deferred residuals.
    pub(super) fn rest(&mut self) {
        for (e, waits) in self.has_pending.iter_mut().enumerate() {
            if std::mem::take(waits) {
                self.pending[e] = NOTHING;
                self.deferred_force[e] = NOTHING;
                self.deferred_square[e] = 0.0;
            }
        }
        self.deferred_residual.fill(ZERO);
        self.total.fill([0.0; 3]);
        self.starts_at_reference = true;
        self.applied.fill([0.0; 3]);
        self.prolongated.clear();
        self.secant.fill(1.0);
        self.last_turn = 0;
        self.deferred.clear();
        for list in [
            &mut self.deferred_points,
            &mut self.loaded,
            &mut self.corrected,
            &mut self.outer_points,
            &mut self.to_refine,
        ] {
            list.clear();
        }
    }

    /// Lists of elements that keep room for all of them.
    pub(super) fn element_lists(&mut self) -> [&mut List; 3] {
        [&mut self.set, &mut self.refined, &mut self.to_refine]
    }

    /// Lists of points that keep room for all of them.
    pub(super) fn point_lists(&mut self) -> [&mut List; 6] {
        [
            &mut self.points,
            &mut self.loaded,
            &mut self.corrected,
            &mut self.outer_points,
            &mut self.deferred_points,
            &mut self.stiffened,
        ]
    }

    /// Drops the elements and points from these numbers on.
    pub(super) fn shrink(&mut self, elements: usize, points: usize) {
        if points >= self.total.len() && elements >= self.pending.len() {
            return;
        }
        for list in self.element_lists() {
            list.shrink(elements);
        }
        for list in self.point_lists() {
            list.shrink(points);
        }
        for vectors in [
            &mut self.e,
            &mut self.d,
            &mut self.b,
            &mut self.r,
            &mut self.outer_force,
            &mut self.deferred_residual,
            &mut self.step_correction,
        ] {
            trim(vectors, points);
        }
        for totals in [&mut self.total, &mut self.applied, &mut self.prolongated] {
            trim(totals, points);
        }
        trim(&mut self.inside, points);
        trim(&mut self.free, points);
        trim(&mut self.added_bound, points);
        trim(&mut self.inverse, points);
        trim(&mut self.stiffness_of, elements);
        trim(&mut self.pending, elements);
        trim(&mut self.deferred_force, elements);
        trim(&mut self.has_pending, elements);
        trim(&mut self.deferred_square, elements);
        trim(&mut self.secant, elements);
        // The next cycle fills it again, and the next contacts need fewer.
        self.deferred = Vec::new();
        (self.stiffened_elements, self.spare) = Default::default();
    }

    /// Flags elements with a corner whose total changed by more than `least` m along an axis since the last call.
    pub(super) fn take_moved(&mut self, level: &Level, least: f64) -> Vec<bool> {
        self.prolongated.resize(self.total.len(), [0.0; 3]);
        let mut moved = |(total, prolongated): (&[f64; 3], &mut [f64; 3])| {
            let has = (0..3).any(|a| (total[a] - prolongated[a]).abs() > least);
            if has {
                *prolongated = *total;
            }
            has
        };
        let points = self.total.iter().zip(&mut self.prolongated);
        let points: Vec<bool> = points.map(&mut moved).collect();
        let has_moved = |corners: &[u32; 8]| corners.iter().any(|&p| points[p as usize]);
        level.corners.iter().map(has_moved).collect()
    }

    /// Adds to the load of a point.
    #[inline]
    pub(super) fn load(&mut self, point: u32, value: &Quad, weight: f32) {
        if self.loaded.insert(point) {
            self.b[point as usize] = ZERO;
        }
        let b = &mut self.b[point as usize];
        *b = plus(b, weight, value);
    }

    /// Adds `share` of a displacement to the pending one of an element, and its force to the deferred residual. Returns
    /// the largest corner force of the pending displacement in N, and its largest difference between two corners in m.
    #[inline(always)]
    pub(super) fn defer_displacement(
        &mut self,
        level: &Level,
        element: u32,
        by: &Corners,
        force: &Corners,
        share: f32,
    ) -> [f32; 2] {
        let e = element as usize;
        self.has_pending[e] = true;
        let (pending, deferred_force) = (&mut self.pending[e], &mut self.deferred_force[e]);
        let mut most = 0.0f32;
        for (c, &point) in level.corners[e].iter().enumerate() {
            self.deferred_points.insert(point);
            let g = &mut self.deferred_residual[point as usize];
            *g = plus(g, -share, &force[c]);
            pending[c] = plus(&pending[c], share, &by[c]);
            deferred_force[c] = plus(&deferred_force[c], share, &force[c]);
            most = most.max(square(&deferred_force[c]));
        }
        self.deferred_square[e] = most;
        let (mut low, mut high) = (pending[0], pending[0]);
        for p in &pending[1..] {
            for a in 0..4 {
                low[a] = if p[a] < low[a] { p[a] } else { low[a] };
                high[a] = if p[a] > high[a] { p[a] } else { high[a] };
            }
        }
        let apart = plus(&high, -1.0, &low);
        [most.sqrt(), apart[0].max(apart[1]).max(apart[2])]
    }

    /// The next element in rotation among those with at least half of the largest deferred force. Rotation keeps an
    /// element that soon defers as much again from starving the others.
    pub(super) fn next_deferred(&mut self) -> Option<u32> {
        let square = |e: u32| self.deferred_square[e as usize];
        let waits = |e: &u32| self.has_pending[*e as usize] && !self.refined.contains(*e);
        let waiting = || (0..self.has_pending.len() as u32).filter(waits);
        let least = 0.25 * waiting().map(square).fold(0.0, f32::max);
        let much = || waiting().filter(|&e| square(e) >= least);
        let next = much()
            .find(|&e| e > self.last_turn)
            .or_else(|| much().next());
        self.last_turn = next.unwrap_or(0);
        next
    }

    /// Takes the pending displacement of an element and removes its force from the deferred residual.
    pub(super) fn take_pending(&mut self, level: &Level, element: u32) -> Corners {
        let e = element as usize;
        let pending = std::mem::replace(&mut self.pending[e], NOTHING);
        let deferred_force = std::mem::replace(&mut self.deferred_force[e], NOTHING);
        self.has_pending[e] = false;
        self.deferred_square[e] = 0.0;
        for (&point, deferred_force) in level.corners[e].iter().zip(&deferred_force) {
            self.deferred_points.insert(point);
            let g = &mut self.deferred_residual[point as usize];
            *g = plus(g, 1.0, deferred_force);
            // Rounded sums do not cancel exactly: a point without pending elements has no deferred residual.
            let settled = |e: &u32| !self.has_pending[*e as usize];
            if level.around.row(point).iter().all(settled) {
                self.deferred_residual[point as usize] = ZERO;
            }
        }
        pending
    }

    /// Takes elements below `len` from now on.
    pub(super) fn grow_pending(&mut self, len: usize) {
        self.pending.resize(len, NOTHING);
        self.deferred_force.resize(len, NOTHING);
        self.has_pending.resize(len, false);
        self.deferred_square.resize(len, 0.0);
        self.secant.resize(len, 1.0);
    }

    /// Drops points whose deferred residual is zero.
    pub(super) fn trim(&mut self) {
        let lag = &self.deferred_residual;
        self.deferred_points.retain(|p| lag[p as usize] != ZERO);
    }

    /// Activates the children of the coarser level's refined elements, or all elements on the coarsest level.
    pub(super) fn choose(&mut self, level: &Level, above: Option<(&Level, &List)>) {
        self.set.clear();
        for &point in &self.points.items {
            self.inside[point as usize] = 0;
            self.free[point as usize] = false;
        }
        self.points.clear();
        match above {
            Some((coarser, refined)) => {
                for &parent in &refined.items {
                    for &child in coarser.children.row(parent) {
                        self.set.insert(child);
                    }
                }
            }
            None => (0..level.corners.len() as u32).for_each(|e| {
                self.set.insert(e);
            }),
        }
        self.set.sort();
        for &element in &self.set.items {
            for point in level.corners[element as usize] {
                self.points.insert(point);
                self.inside[point as usize] += 1;
            }
        }
        self.points.sort();
        for &point in &self.points.items {
            self.free[point as usize] = self.inside[point as usize] == level.around.len(point);
        }
    }
}

/// Brings the totals of the active points up to date with the coarser level.
pub(super) fn follow_coarser(hierarchy: &Hierarchy, grids: &mut [CoarseLevel], l: usize) {
    let (finer, coarser) = grids.split_at_mut(l + 1);
    let Some(above) = coarser.first() else { return };
    let grid = &mut finer[l];
    for &point in &grid.points.items {
        let p = point as usize;
        let (total, applied) = (&mut grid.total[p], &mut grid.applied[p]);
        let now = hierarchy.levels[l]
            .prolongation
            .interpolate_exactly(p, &above.total);
        update_total(now, total, applied);
    }
}

/// Brings all points up to date with the totals of the coarser level that changed by more than `least` m since the last
/// call.
pub(super) fn prolongate_changes(
    hierarchy: &Hierarchy,
    grids: &mut [CoarseLevel],
    l: usize,
    least: f64,
) {
    let (finer, coarser) = grids.split_at_mut(l + 1);
    let Some(above) = coarser.first_mut() else {
        return;
    };
    let moved = above.take_moved(&hierarchy.levels[l + 1], least);
    let grid = &mut finer[l];
    let prolongation = &hierarchy.levels[l].prolongation;
    for p in 0..prolongation.len() {
        if prolongation
            .element_of(p)
            .is_some_and(|e| moved[e as usize])
        {
            let now = prolongation.interpolate_exactly(p, &above.total);
            update_total(now, &mut grid.total[p], &mut grid.applied[p]);
        }
    }
}

/// Adds the change of the interpolated coarser total to the total of a point.
#[inline]
pub(super) fn update_total(now: [f64; 3], total: &mut [f64; 3], applied: &mut [f64; 3]) {
    for a in 0..3 {
        total[a] += now[a] - applied[a];
    }
    *applied = now;
}

/// Inverse of a diagonal block; zero for an empty one.
pub(super) fn invert(m: &[f32; 6]) -> [f32; 6] {
    if m[0] + m[1] + m[2] <= 0.0 {
        return [0.0; 6];
    }
    super::law::invert(&m.map(f64::from)).map(|v| v as f32)
}

/// Product of a symmetric block and a vector.
#[inline(always)]
pub(super) fn apply(m: &[f32; 6], v: &Quad) -> Quad {
    [
        m[0] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[3] * v[0] + m[1] * v[1] + m[5] * v[2],
        m[4] * v[0] + m[5] * v[1] + m[2] * v[2],
        0.0,
    ]
}
