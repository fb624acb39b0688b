//! Vectors of f32 and f64 in the width of the machine, with arithmetic operators.
//!
//! Every operation is one IEEE operation per lane, without fused multiply-add and without sums across lanes. So the
//! vector width changes no bit of a result.

use std::ops::{Add, Div, Mul, Sub};

use pulp::Simd;

/// Padding of all rows, in lanes; a multiple of every width in use.
pub(crate) const LANES: usize = 16;

/// `to += w from` in f64; lengths are whole vectors of any width in use.
#[inline(always)]
pub(crate) fn add_scaled<S: Simd>(simd: S, to: &mut [f64], w: f64, from: &[f64]) {
    let (to, from) = (S::as_mut_simd_f64s(to).0, S::as_simd_f64s(from).0);
    let w = simd.splat_f64s(w);
    for (to, from) in to.iter_mut().zip(from) {
        *to = simd.add_f64s(*to, simd.mul_f64s(w, *from));
    }
}

/// A vector.
#[derive(Clone, Copy)]
pub(crate) struct V<S: Simd> {
    simd: S,
    lanes: S::f32s,
}

impl<S: Simd> V<S> {
    /// Numbers of a vector.
    pub(crate) const WIDTH: usize = S::F32_LANES;

    #[inline(always)]
    pub(crate) fn all(simd: S, value: f32) -> Self {
        let lanes = simd.splat_f32s(value);
        Self { simd, lanes }
    }

    /// The numbers from `at` on.
    #[inline(always)]
    pub(crate) fn load(simd: S, from: &[f32], at: usize) -> Self {
        let lanes = S::as_simd_f32s(&from[at..at + Self::WIDTH]).0[0];
        Self { simd, lanes }
    }

    /// The whole numbers from `at` on.
    #[inline(always)]
    pub(crate) fn load_short(simd: S, from: &[i16], at: usize) -> Self {
        let mut numbers = [0.0; LANES];
        for (to, v) in numbers.iter_mut().zip(&from[at..at + Self::WIDTH]) {
            *to = f32::from(*v);
        }
        Self::load(simd, &numbers, 0)
    }

    /// Puts them at `at`.
    #[inline(always)]
    pub(crate) fn store(self, to: &mut [f32], at: usize) {
        S::as_mut_simd_f32s(&mut to[at..at + Self::WIDTH]).0[0] = self.lanes;
    }

    /// Scalar fallback, number by number, for rare operations.
    #[inline(always)]
    pub(crate) fn map(self, f: impl Fn(f32) -> f32) -> Self {
        let mut numbers = [0.0; LANES];
        self.store(&mut numbers, 0);
        for v in &mut numbers[..Self::WIDTH] {
            *v = f(*v);
        }
        Self::load(self.simd, &numbers, 0)
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        self.with(self.simd.sqrt_f32s(self.lanes))
    }

    /// The larger; `other` where they are equal, so that the sign of zero does not depend on the machine.
    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        let above = self.simd.less_than_f32s(other.lanes, self.lanes);
        self.with(self.simd.select_f32s(above, self.lanes, other.lanes))
    }

    /// The smaller; `other` where they are equal.
    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        let below = self.simd.less_than_f32s(self.lanes, other.lanes);
        self.with(self.simd.select_f32s(below, self.lanes, other.lanes))
    }

    /// Whether any number is above zero.
    #[inline(always)]
    pub(crate) fn any_above_zero(self) -> bool {
        let zero = self.simd.splat_f32s(0.0);
        let above = self.simd.less_than_f32s(zero, self.lanes);
        self.simd.first_true_m32s(above) < Self::WIDTH
    }

    /// `value` where `self` is above zero, zero elsewhere.
    #[inline(always)]
    pub(crate) fn where_above_zero(self, value: Self) -> Self {
        let zero = self.simd.splat_f32s(0.0);
        let above = self.simd.less_than_f32s(zero, self.lanes);
        self.with(self.simd.select_f32s(above, value.lanes, zero))
    }

    #[inline(always)]
    fn with(self, lanes: S::f32s) -> Self {
        Self {
            simd: self.simd,
            lanes,
        }
    }
}

/// A vector of f64.
#[derive(Clone, Copy)]
pub(crate) struct Wide<S: Simd> {
    simd: S,
    lanes: S::f64s,
}

impl<S: Simd> Wide<S> {
    /// Numbers of a vector.
    pub(crate) const WIDTH: usize = S::F64_LANES;

    #[inline(always)]
    pub(crate) fn all(simd: S, value: f64) -> Self {
        let lanes = simd.splat_f64s(value);
        Self { simd, lanes }
    }

    /// The numbers from `at` on.
    #[inline(always)]
    pub(crate) fn load(simd: S, from: &[f64], at: usize) -> Self {
        let lanes = S::as_simd_f64s(&from[at..at + Self::WIDTH]).0[0];
        Self { simd, lanes }
    }

    /// Puts them at `at`.
    #[inline(always)]
    pub(crate) fn store(self, to: &mut [f64], at: usize) {
        S::as_mut_simd_f64s(&mut to[at..at + Self::WIDTH]).0[0] = self.lanes;
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        self.with(self.simd.sqrt_f64s(self.lanes))
    }

    /// `below` where `self` is less than `bound`, `other` elsewhere.
    #[inline(always)]
    pub(crate) fn where_below(self, bound: Self, below: Self, other: Self) -> Self {
        let is_below = self.simd.less_than_f64s(self.lanes, bound.lanes);
        self.with(self.simd.select_f64s(is_below, below.lanes, other.lanes))
    }

    /// Whether any number is above zero.
    #[inline(always)]
    pub(crate) fn any_above_zero(self) -> bool {
        let zero = self.simd.splat_f64s(0.0);
        let above = self.simd.less_than_f64s(zero, self.lanes);
        self.simd.first_true_m64s(above) < Self::WIDTH
    }

    #[inline(always)]
    fn with(self, lanes: S::f64s) -> Self {
        Self {
            simd: self.simd,
            lanes,
        }
    }
}

macro_rules! operators {
    ($vector:ident: $($operator:ident $method:ident $of_lanes:ident),*) => {
        $(impl<S: Simd> $operator for $vector<S> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                self.with(self.simd.$of_lanes(self.lanes, other.lanes))
            }
        })*
    };
}

operators!(V: Add add add_f32s, Sub sub sub_f32s, Mul mul mul_f32s, Div div div_f32s);
operators!(Wide: Add add add_f64s, Sub sub sub_f64s, Mul mul mul_f64s, Div div div_f64s);
