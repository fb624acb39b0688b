//! Stabilisation energy of compressed springs, and stiffening of extreme springs.
//!
//! A spring of the length law at r = |d| < l0 has the transverse stiffness k(1 - l0/r), -k at half its length. From 30
//! to 40 % of local strain this exceeds the support of its neighbours: the lattice buckles, and cells fold sideways.
//! Against that (reconstructed) a compressed spring is held to its direction at rest n0 by
//!
//! ```text
//! χ(r) (r - d·n0)          χ = k l0 t²(3 - 2t),  t = 1 - r/(c l0) within 0..1
//! ```
//!
//! The energy vanishes at rest and in tension, and up to 1 - c of compression for any rotation. Compressed along n0 a
//! spring keeps its force, and its transverse stiffness becomes k(1 - l0/r) + χ/r, at least -k/4. Towards r = 0 the sum
//! with the length law is the offset law k(d - d0), convex in all directions. (An energy that is invariant under
//! rotation at full length can not be convex everywhere within it.)
//!
//! Extreme springs (`law.rs`) stiffen smoothly: below r = `α_min` l0, with y = `α_min` l0 - r, they push with
//! with
//!
//! ```text
//! P = S k y²/(y + h l0)
//! ```
//!
//! and are additionally held by P in the place of χ, which cancels the transverse stiffness lost by that push.

use pulp::Simd;

use super::brick::{DIRECTIONS, Form, SPAN};
use super::corners::NEAR;
use super::kernel::{Ends, Group, LEAD, Local, LocalBlocks, SPRINGS, dot};
use super::lanes::V;
use super::law::{EXTREME, GUARD};

/// Weight of the stabilisation in the diagonal blocks: two ends, as it acts on single springs.
const SINGLE: f32 = 2.0;
/// Further relative compression of a spring, or loss of volume of a corner, that the blocks allow for until they are
/// recomputed.
pub(crate) const MARGIN: f32 = 0.05;

/// c: relative length below which a spring is held.
const HELD: f32 = 0.9;
/// S: stiffness of a spring far beyond its limit, relative to its own.
const PRESSED: f32 = 4.0;
/// h: relative length over which an extreme spring stiffens.
const ONSET: f32 = 0.3;

/// Stabilisation terms of a compressed spring.
struct Stabilisation<S: Simd> {
    /// P in N, and its derivative by -r in N/m.
    push: V<S>,
    stiffness: V<S>,
    /// χ and P in N, and their derivative by r in N/m.
    back: V<S>,
    slope: V<S>,
}

impl<S: Simd> Stabilisation<S> {
    /// Above zero where a spring of this length is held or extreme, given `α_min`.
    #[inline(always)]
    fn sets_in(simd: S, limit: f32, length: V<S>, rest: V<S>) -> V<S> {
        V::all(simd, limit.max(HELD)) * rest - length
    }

    /// The terms of a spring of stiffness `k`.
    #[inline(always)]
    fn new(simd: S, limit: f32, k: V<S>, length: V<S>, rest: V<S>) -> Self {
        let all = |v: f32| V::all(simd, v);
        let t = all(1.0) - length / (all(HELD) * rest);
        let t = t.max(all(0.0));
        let held = k * rest * t * t * (all(3.0) - all(2.0) * t);
        let fall = all(6.0 / HELD) * k * t * (all(1.0) - t);
        let y = (all(limit) * rest - length).max(all(0.0));
        let h = all(ONSET) * rest;
        let sum = y + h;
        let push = all(PRESSED) * k * y * y / sum;
        let stiffness = all(PRESSED) * k * y * (sum + h) / (sum * sum);
        Self {
            push,
            stiffness,
            back: held + push,
            slope: all(0.0) - fall - stiffness,
        }
    }

    /// The force on the spring's start along d/|d|, and against n0, in N. `over` is r - d·n0.
    #[inline(always)]
    fn pull(&self, over: V<S>) -> [V<S>; 2] {
        [self.slope * over + self.back - self.push, self.back]
    }

    /// Upper bound of the added stiffness in N/m: along d, across it, and to both where the spring has turned from n0
    /// (|n - n0|² = 2 (1 - cos) bounds the coupling).
    #[inline(always)]
    fn stiffness(&self, simd: S, length: V<S>, over: V<S>) -> [V<S>; 3] {
        let away = (V::all(simd, 2.0) * over.max(V::all(simd, 0.0)) / length).sqrt();
        let turning = (V::all(simd, 0.0) - self.slope) * away;
        [self.stiffness, self.back / length, turning]
    }
}

impl<S: Simd> Group<S> {
    /// Above zero where the spring is far from its rest length. (Below zero where no spring exists: its rest length is
    /// 1 m.)
    #[inline(always)]
    fn strained(&self, simd: S) -> V<S> {
        let change = self.excess.max(V::all(simd, 0.0) - self.excess);
        change - V::all(simd, NEAR) * self.rest_square()
    }

    /// |d| - d·d0/l0: excess length over the projection on the rest direction.
    #[inline(always)]
    fn over(&self) -> V<S> {
        self.length - dot(&self.now, &self.rest) / self.rest_length
    }

    /// Extension of the spring beyond its limit in m, above zero.
    #[inline(always)]
    fn prescribed_displacements(&self, simd: S, limit: f32) -> V<S> {
        self.length - V::all(simd, limit) * self.rest_length
    }
}

/// Forces of the springs, and whether a strain is so large that corners must be checked.
#[inline(always)]
pub(crate) fn stabilised_forces<S: Simd>(
    simd: S,
    form: &Form,
    u: &Local,
    ends: &mut Ends<3>,
) -> (Local, bool) {
    let zero = V::all(simd, 0.0);
    let mut strained = zero;
    for direction in 0..DIRECTIONS {
        let mut from = 0;
        while from < SPAN {
            if form.uses(direction, from, V::<S>::WIDTH) {
                let s = Group::load(simd, form, u, direction, from);
                strained = strained.max(s.strained(simd));
                let k = V::load(simd, &form.stiffness[direction], from);
                let mut t = s.tension(simd, form, k);
                let [least, most] = form.curve.limits;
                let (long, guarded) = (s.prescribed_displacements(simd, most), s.guarded(simd));
                let pressed = Stabilisation::sets_in(simd, least, s.length, s.rest_length);
                // Rare and expensive: two roots and a division are the cost of an ordinary spring.
                let unusual = k.where_above_zero(pressed.max(long).max(guarded));
                let unusual = unusual.any_above_zero();
                let mut guard = zero;
                if unusual {
                    let hold = Stabilisation::new(simd, least, k, s.length, s.rest_length);
                    let [pull, back] = hold.pull(s.over());
                    let long = V::all(simd, EXTREME) * k * long.max(zero);
                    t = t + (long + pull) / s.length;
                    guard = V::all(simd, GUARD) * k * guarded.max(zero) / s.rest_square();
                    guard = guard + back / s.rest_length;
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
    (ends.collect(simd, -1.0), strained.any_above_zero())
}

/// Diagonal blocks of the springs, and whether a strain is so large that corners must be checked.
#[inline(always)]
pub(crate) fn stabilised_tangents<S: Simd>(
    simd: S,
    form: &Form,
    u: &Local,
    per_spacing: f32,
    ends: &mut Ends<6>,
) -> (LocalBlocks, bool) {
    let all = |v: f32| V::all(simd, v);
    let mut strained = all(0.0);
    for direction in 0..DIRECTIONS {
        let mut from = 0;
        while from < SPAN {
            if form.uses(direction, from, V::<S>::WIDTH) {
                let s = Group::load(simd, form, u, direction, from);
                strained = strained.max(s.strained(simd));
                let plain = V::load(simd, &form.stiffness[direction], from);
                let k = s.stiffened(simd, form, plain * all(SPRINGS));
                let plain = plain * all(SINGLE);
                let [least, most] = form.curve.limits;
                let stiff = s
                    .prescribed_displacements(simd, most)
                    .where_above_zero(all(EXTREME) * plain);
                let floor = s.floor(simd, per_spacing);
                let turning = all(1.0) - s.rest_length / s.length;
                let (mut first, mut across) = (k, k * turning.max(floor));
                let margin = all(MARGIN) * s.rest_length;
                let length = (s.length - margin).max(margin);
                let pressed = Stabilisation::sets_in(simd, least, length, s.rest_length);
                if plain.where_above_zero(pressed).any_above_zero() {
                    let hold = Stabilisation::new(simd, least, plain, length, s.rest_length);
                    let [along, held, coupled] = hold.stiffness(simd, length, s.over());
                    first = first + along + coupled;
                    let held = held.where_above_zero(k * turning + held);
                    across = across.max(held) + coupled;
                }
                let (first, across) = (first + stiff, across + stiff);
                let along = (first - across) / s.square;
                let guard = all(GUARD) * plain / s.rest_square();
                let guard = s.guarded(simd).where_above_zero(guard);
                s.put_block([along, across, guard], &mut ends.0[direction], LEAD + from);
            } else {
                ends.none(simd, direction, from);
            }
            from += V::<S>::WIDTH;
        }
    }
    (ends.collect(simd, 1.0), strained.any_above_zero())
}
