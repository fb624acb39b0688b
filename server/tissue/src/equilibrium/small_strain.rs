//! Small-strain expansion of the spring law, without roots and divisions.
//!
//! In most of a body strains are small. With `e = (|d|² - l0²) / l0²` the length law reads
//!
//! ```text
//! k (|d| - l0) / |d| = k (1 - (1 + e)^-1/2) = k e g(e)
//! ```
//!
//! and g is a polynomial to the digits of f32 while |e| is small. A root and a division cost as much as all other
//! operations of a spring. Above a strain of a tenth a brick uses the general law.

use pulp::Simd;

use super::brick::{DIRECTIONS, Form, LOCALS, OFFSETS, PADDED, SPAN};
use super::kernel::{Ends, LEAD, Local};
use super::lanes::V;

/// Range of |e|, without and with stabilised springs (these act from 0.19 on).
const STRAIN_MAX: [f32; 2] = [0.2, 0.19];
/// Coefficients of g, constant first: least squares in Chebyshev points of ±0.2, relative error at most 1.5e-7.
const POLYNOMIAL: [f32; 7] = [
    0.5,
    -0.375_001_46,
    0.312_503_22,
    -0.273_144_8,
    0.245_696_25,
    -0.239_994_6,
    0.225_102_75,
];
/// Displacement of a node relative to the brick's first, along an axis and in lengths of the shortest spring, up to
/// which no guard can act: two such ends are 0.69 apart.
pub(crate) const DISPLACEMENT_MAX: f32 = 0.2;

/// Relative lengths within which no spring of the material may be extreme.
const LENGTHS: [f32; 2] = [0.89, 1.1];

impl Form {
    /// Whether its springs follow the length law alone at small strain.
    pub(crate) fn is_plain(&self) -> bool {
        let [least, most] = self.curve.limits;
        !self.skewed && self.curve.stiffening == 0.0 && least < LENGTHS[0] && most > LENGTHS[1]
    }
}

/// Whether the nodes have moved so little that the expansion may apply.
#[inline(always)]
fn is_small<S: Simd>(simd: S, form: &Form, u: &Local) -> bool {
    let zero = V::all(simd, 0.0);
    let mut most = zero;
    for row in &**u {
        let mut from = 0;
        while from < LOCALS {
            let v = V::load(simd, row, from);
            most = most.max(v).max(zero - v);
            from += V::<S>::WIDTH;
        }
    }
    !(most - V::all(simd, form.small_displacement)).any_above_zero()
}

/// Forces of the springs of a brick in N, if all strains are within the range of the expansion.
#[inline(always)]
pub(crate) fn small_strain_forces<S: Simd>(
    simd: S,
    form: &Form,
    u: &Local,
    ends: &mut Ends<3>,
) -> Option<Local> {
    if !is_small(simd, form, u) {
        return None;
    }
    let mut most = V::all(simd, 0.0);
    for direction in 0..DIRECTIONS {
        let offset = OFFSETS[direction];
        let mut from = 0;
        while from < SPAN {
            if form.uses(direction, from, V::<S>::WIDTH) {
                let rest = differences(simd, &form.rest, from, offset);
                let by = differences(simd, u, from, offset);
                let now = [rest[0] + by[0], rest[1] + by[1], rest[2] + by[2]];
                let excess = by[0] * (rest[0] + now[0])
                    + by[1] * (rest[1] + now[1])
                    + by[2] * (rest[2] + now[2]);
                let e = excess * V::load(simd, &form.per_square[direction], from);
                most = most.max(e * e);
                let mut g = V::all(simd, POLYNOMIAL[6]);
                for c in POLYNOMIAL[..6].iter().rev() {
                    g = g * e + V::all(simd, *c);
                }
                let t = V::load(simd, &form.stiffness[direction], from) * e * g;
                for a in 0..3 {
                    (t * now[a]).store(&mut ends.0[direction][a], LEAD + from);
                }
            } else {
                ends.none(simd, direction, from);
            }
            from += V::<S>::WIDTH;
        }
    }
    let limit = STRAIN_MAX[usize::from(form.curve.held)];
    let small = !(most - V::all(simd, limit * limit)).any_above_zero();
    small.then_some(ends.collect(simd, -1.0))
}

#[inline(always)]
fn differences<S: Simd>(simd: S, of: &[[f32; PADDED]; 3], from: usize, offset: usize) -> [V<S>; 3] {
    let one = |row: &[f32; PADDED]| V::load(simd, row, from + offset) - V::load(simd, row, from);
    [one(&of[0]), one(&of[1]), one(&of[2])]
}
