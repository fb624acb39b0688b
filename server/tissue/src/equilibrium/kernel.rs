//! Forces and tangent blocks of a brick: the inner loops of the equilibrium.
//!
//! All functions are `inline(always)`, so that they are compiled for the vector width of the machine.

use std::ops::{Deref, DerefMut};

use pulp::{Simd, WithSimd};

use super::brick::{Brick, DIRECTIONS, Form, LOCALS, OFFSETS, PADDED, SPAN};
use super::corners::{corner_forces, corner_tangents};
use super::lanes::V;
use super::law::{EXTREME, GUARD, GUARDED, LONG, SHORT, SIDEWAYS};
use super::stabilisation::{stabilised_forces, stabilised_tangents};
use super::volume::{volume_forces, volume_tangents};
use crate::Vec3;

/// Factor by which the diagonal blocks of springs bound their matrix; 2 holds for any mesh. On lattices with all
/// diagonals the highest mode is at 1.6 (alternating nodes load edges and body diagonals twice, face diagonals not at
/// all); measured, 1.6 converges and 1.3 does not.
pub(crate) const SPRINGS: f32 = 1.7;

/// Arrays aligned to cache lines: a load across two lines takes twice as long.
#[repr(C, align(64))]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct Aligned<T>(pub(crate) T);

impl<T> Deref for Aligned<T> {
    type Target = T;
    #[inline(always)]
    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> DerefMut for Aligned<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

/// Three components over the nodes of a brick.
pub(crate) type Local = Aligned<[[f32; PADDED]; 3]>;

/// Symmetric blocks over the nodes of a brick: xx, yy, zz, xy, xz, yz.
pub(crate) type LocalBlocks = Aligned<[[f32; PADDED]; 6]>;

/// Axes of the entries of a symmetric block.
pub(crate) const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];

/// Forces of a brick on its nodes, in N. (A closure would not be inlined for wider vectors.)
pub(crate) struct Forces<'a> {
    pub(crate) brick: &'a Brick,
    pub(crate) form: &'a Form,
    /// Displacements of all nodes in m.
    pub(crate) u: &'a [Vec3],
    pub(crate) to: &'a mut [[f32; LOCALS]; 3],
    pub(crate) scratch: &'a mut Ends<3>,
}

impl WithSimd for Forces<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let local = gather(&self.brick.nodes, self.u);
        let mut f = if self.form.curve.held {
            let (mut f, strained) = stabilised_forces(simd, self.form, &local, self.scratch);
            if strained || self.form.skewed {
                corner_forces(simd, self.form, &local, &mut f);
            }
            f
        } else {
            spring_forces(simd, self.form, &local, self.scratch)
        };
        if self.form.has_bulk {
            volume_forces(simd, self.brick, self.form, self.u, &local, &mut f);
        }
        for (to, f) in self.to.iter_mut().zip(&*f) {
            to.copy_from_slice(&f[..LOCALS]);
        }
    }
}

/// Diagonal tangent blocks of the nodes of a brick in N/m. Springs count [`SPRINGS`] times and the volume term eight
/// times, so that the blocks bound the whole matrix.
pub(crate) struct Tangents<'a> {
    pub(crate) brick: &'a Brick,
    pub(crate) form: &'a Form,
    /// Displacements of all nodes in m, or at rest.
    pub(crate) u: Option<&'a [Vec3]>,
    pub(crate) per_spacing: f32,
    pub(crate) scratch: &'a mut Ends<6>,
}

impl WithSimd for Tangents<'_> {
    type Output = LocalBlocks;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> LocalBlocks {
        let local = match self.u {
            Some(u) => gather(&self.brick.nodes, u),
            None => Aligned([[0.0; PADDED]; 3]),
        };
        let (form, per_spacing, scratch) = (self.form, self.per_spacing, self.scratch);
        let mut m = if form.curve.held {
            let (mut m, strained) = stabilised_tangents(simd, form, &local, per_spacing, scratch);
            if strained || form.skewed {
                corner_tangents(simd, form, &local, per_spacing, &mut m);
            }
            m
        } else {
            spring_tangents(simd, form, &local, per_spacing, scratch)
        };
        if form.has_bulk {
            volume_tangents(simd, form, &local, &mut m);
        }
        m
    }
}

/// Displacements of a brick's nodes relative to its first, in f32.
#[inline(always)]
fn gather(nodes: &[u32; LOCALS], u: &[Vec3]) -> Local {
    let mut local = Aligned([[0.0; PADDED]; 3]);
    let origin = u[nodes[0] as usize];
    for (i, &node) in nodes.iter().enumerate() {
        let d = u[node as usize] - origin;
        local[0][i] = d.x as f32;
        local[1][i] = d.y as f32;
        local[2][i] = d.z as f32;
    }
    local
}

/// Forces of springs on their ends, by direction: entry `i` belongs to the spring that starts at node `i`, behind
/// [`LEAD`] zeros.
///
/// Adding each group to both ends at once would reload vectors that overlap recent stores, and stall. So all springs
/// are stored first, and each node then sums over its 26 neighbours.
#[repr(C, align(64))]
pub(crate) struct Ends<const C: usize>(pub(crate) [[[f32; LEAD + SPAN]; C]; DIRECTIONS]);

/// Leading zeros: as many as the largest offset, in whole vectors.
pub(crate) const LEAD: usize = 16;

impl<const C: usize> Ends<C> {
    pub(crate) fn new() -> Self {
        Self([[[0.0; LEAD + SPAN]; C]; DIRECTIONS])
    }

    /// Stores that no spring of a direction starts from `from` on.
    #[inline(always)]
    pub(crate) fn none<S: Simd>(&mut self, simd: S, direction: usize, from: usize) {
        for row in &mut self.0[direction] {
            V::all(simd, 0.0).store(row, LEAD + from);
        }
    }

    /// Sum of the springs that start at each node, and `sign` times those that end there.
    #[inline(always)]
    pub(crate) fn collect<S: Simd>(&self, simd: S, sign: f32) -> Aligned<[[f32; PADDED]; C]> {
        let mut all = Aligned([[0.0; PADDED]; C]);
        for (c, to) in all.iter_mut().enumerate() {
            let mut from = 0;
            while from < SPAN {
                let (mut starts, mut ends) = (V::all(simd, 0.0), V::all(simd, 0.0));
                for (rows, offset) in self.0.iter().zip(OFFSETS) {
                    starts = starts + V::load(simd, &rows[c], LEAD + from);
                    ends = ends + V::load(simd, &rows[c], LEAD + from - offset);
                }
                (starts + V::all(simd, sign) * ends).store(to, from);
                from += V::<S>::WIDTH;
            }
        }
        all
    }
}

/// One group of springs: start index and current state.
pub(crate) struct Group<S: Simd> {
    pub(crate) rest: [V<S>; 3],
    pub(crate) now: [V<S>; 3],
    /// |d|² - l0².
    pub(crate) excess: V<S>,
    pub(crate) square: V<S>,
    pub(crate) length: V<S>,
    pub(crate) rest_length: V<S>,
}

impl<S: Simd> Group<S> {
    #[inline(always)]
    pub(crate) fn load(simd: S, form: &Form, u: &Local, direction: usize, from: usize) -> Self {
        let offset = OFFSETS[direction];
        let difference =
            |of: &[f32; PADDED]| V::load(simd, of, from + offset) - V::load(simd, of, from);
        let rest = [
            difference(&form.rest[0]),
            difference(&form.rest[1]),
            difference(&form.rest[2]),
        ];
        let by = [difference(&u[0]), difference(&u[1]), difference(&u[2])];
        let now = [rest[0] + by[0], rest[1] + by[1], rest[2] + by[2]];
        let both = [rest[0] + now[0], rest[1] + now[1], rest[2] + now[2]];
        let square = dot(&now, &now).max(V::all(simd, 1e-20));
        Self {
            rest,
            now,
            excess: dot(&by, &both),
            square,
            length: square.sqrt(),
            rest_length: V::load(simd, &form.rest_length[direction], from),
        }
    }

    #[inline(always)]
    pub(crate) fn rest_square(&self) -> V<S> {
        self.rest_length * self.rest_length
    }

    /// θ l0² - d·d0, above zero where the guard pushes.
    #[inline(always)]
    pub(crate) fn guarded(&self, simd: S) -> V<S> {
        V::all(simd, GUARDED) * self.rest_square() - dot(&self.now, &self.rest)
    }

    /// The guard force over its length, in N/m, given its stiffness at rest.
    #[inline(always)]
    pub(crate) fn tension(&self, simd: S, form: &Form, k: V<S>) -> V<S> {
        let stretch = self.excess / ((self.length + self.rest_length) * self.length);
        if form.curve.stiffening > 0.0 {
            let b = V::all(simd, form.curve.stiffening);
            return k * stretch * (b * stretch * self.length / self.rest_length).map(growth);
        }
        k * stretch
    }

    /// The longitudinal tangent stiffness, given `k` at rest.
    #[inline(always)]
    pub(crate) fn stiffened(&self, simd: S, form: &Form, k: V<S>) -> V<S> {
        if form.curve.stiffening > 0.0 {
            let b = V::all(simd, form.curve.stiffening);
            let strain = b * (self.length - self.rest_length) / self.rest_length;
            return k * strain.map(exponential).max(V::all(simd, 0.05));
        }
        k
    }

    /// The floor of `law.rs` for the transverse stiffness, relative to the longitudinal one.
    #[inline(always)]
    pub(crate) fn floor(&self, simd: S, per_spacing: f32) -> V<S> {
        let all = |v: f32| V::all(simd, v);
        let slope = (self.rest_length * all(per_spacing) - all(SHORT)) / all(LONG - SHORT);
        let slope = slope.max(all(0.0)).min(all(1.0));
        all(1.0) + slope * all(SIDEWAYS - 1.0)
    }

    /// Stores the block of a spring: excess of longitudinal over transverse stiffness per squared length, transverse
    /// stiffness, and the guard along the direction at rest.
    #[inline(always)]
    pub(crate) fn put_block<const N: usize>(
        &self,
        [along, across, guard]: [V<S>; 3],
        to: &mut [[f32; N]; 6],
        at: usize,
    ) {
        for (e, (a, b)) in PAIRS.into_iter().enumerate() {
            let mut v = along * self.now[a] * self.now[b] + guard * self.rest[a] * self.rest[b];
            if e < 3 {
                v = v + across;
            }
            v.store(&mut to[e], at);
        }
    }

    /// Excess of the spring beyond its limits in m: too short and too long, above zero.
    #[inline(always)]
    fn over_limits(&self, simd: S, limits: [f32; 2]) -> [V<S>; 2] {
        let [least, most] = limits.map(|l| V::all(simd, l) * self.rest_length);
        [least - self.length, self.length - most]
    }
}

#[inline(always)]
fn spring_forces<S: Simd>(simd: S, form: &Form, u: &Local, ends: &mut Ends<3>) -> Local {
    let zero = V::all(simd, 0.0);
    for direction in 0..DIRECTIONS {
        let mut from = 0;
        while from < SPAN {
            if form.uses(direction, from, V::<S>::WIDTH) {
                let s = Group::load(simd, form, u, direction, from);
                let k = V::load(simd, &form.stiffness[direction], from);
                let mut t = s.tension(simd, form, k);
                let [short, long] = s.over_limits(simd, form.curve.limits);
                let guarded = s.guarded(simd);
                // Rare and expensive: two roots and a division are the cost of an ordinary spring.
                let unusual = short.max(long).max(guarded).any_above_zero();
                let mut guard = zero;
                if unusual {
                    let excess = long.max(zero) - short.max(zero);
                    t = t + V::all(simd, EXTREME) * k * excess / s.length;
                    guard = V::all(simd, GUARD) * k * guarded.max(zero) / s.rest_square();
                }
                for a in 0..3 {
                    let mut pull = t * s.now[a];
                    if unusual {
                        pull = pull - guard * s.rest[a];
                    }
                    pull.store(&mut ends.0[direction][a], LEAD + from);
                }
            } else {
                ends.none(simd, direction, from);
            }
            from += V::<S>::WIDTH;
        }
    }
    ends.collect(simd, -1.0)
}

#[inline(always)]
fn spring_tangents<S: Simd>(
    simd: S,
    form: &Form,
    u: &Local,
    per_spacing: f32,
    ends: &mut Ends<6>,
) -> LocalBlocks {
    let all = |v: f32| V::all(simd, v);
    for direction in 0..DIRECTIONS {
        let mut from = 0;
        while from < SPAN {
            if form.uses(direction, from, V::<S>::WIDTH) {
                let s = Group::load(simd, form, u, direction, from);
                let k = V::load(simd, &form.stiffness[direction], from) * all(SPRINGS);
                let mut k = s.stiffened(simd, form, k);
                let [short, long] = s.over_limits(simd, form.curve.limits);
                k = k + short.max(long).where_above_zero(all(EXTREME) * k);
                let floor = s.floor(simd, per_spacing);
                let turning = (all(1.0) - s.rest_length / s.length).max(floor);
                let along = k * (all(1.0) - turning) / s.square;
                let across = k * turning;
                let guard = all(GUARD) * k / s.rest_square();
                let guard = s.guarded(simd).where_above_zero(guard);
                s.put_block([along, across, guard], &mut ends.0[direction], LEAD + from);
            } else {
                ends.none(simd, direction, from);
            }
            from += V::<S>::WIDTH;
        }
    }
    ends.collect(simd, 1.0)
}

/// (exp(x) - 1)/x to three digits, monotonic; exp is the 64th power of a parabola.
#[inline(always)]
fn growth(x: f32) -> f32 {
    let x = x.clamp(-60.0, 6.0);
    if x.abs() < 0.25 {
        return 1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0)));
    }
    (exponential(x) - 1.0) / x
}

#[inline(always)]
fn exponential(x: f32) -> f32 {
    let t = x.clamp(-60.0, 6.0) * (1.0 / 64.0);
    let mut p = 1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0)));
    for _ in 0..6 {
        p *= p;
    }
    p
}

#[inline(always)]
pub(crate) fn dot<S: Simd>(a: &[V<S>; 3], b: &[V<S>; 3]) -> V<S> {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<S: Simd>(a: &[V<S>; 3], b: &[V<S>; 3]) -> [V<S>; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[cfg(test)]
mod tests;
