//! Rigid indenters without friction on an elastic layer that is bonded to a rigid base (Hayes, Keer, Herrmann and
//! Mockros 1972).
//!
//! With p(ξ) the Hankel transform of the pressure, the surface of a layer of thickness h sinks by
//!
//! ```text
//! w(r) = C ∫ p(ξ) M(ξ h) J0(ξ r) dξ        C = 2 (1 - ν²) / E
//! M(α) = (2 k sinh 2α - 4 α) / (2 k cosh 2α + 4 α² + 1 + k²)        k = 3 - 4 ν
//! ```
//!
//! The pressure within the contact radius a is written as p(ξ) = ∫ φ(t) cos ξt dt from 0 to a. Abel's inversion then
//! gives a Fredholm equation of the second kind,
//!
//! ```text
//! φ(t) = g(t) + ∫ K(t, s) φ(s) ds      K(t, s) = 2/π ∫ (1 - M(ξ h)) cos ξt cos ξs dξ
//! ```
//!
//! with g = 2/(π C) d under a flat punch and 2/(π C) (d - t²/R) under a ball. The force is 2π ∫ φ dt. Under a ball φ(a) = 0,
//! because the pressure at the edge is finite.

use std::f64::consts::{FRAC_2_PI, PI, TAU};

use nalgebra::{DMatrix, DVector};

/// Points of the quadrature over the contact radius, and over each of the intervals of ξ h.
const POINTS: usize = 24;
const INTERVALS: usize = 6;
/// Upper limit of ξ h, where 1 - M is below 1e-14.
const FAR: f64 = 20.0;

/// Force and depth of an indenter.
#[derive(Debug, Clone, Copy)]
pub(super) struct Indentation {
    pub(super) force_n: f64,
    pub(super) depth_m: f64,
}

/// A bonded layer with a contact radius.
pub(super) struct Layer {
    pub(super) thickness_m: f64,
    pub(super) contact_m: f64,
    pub(super) young_pa: f64,
    pub(super) poisson: f64,
}

impl Layer {
    /// Force on a flat punch of the contact radius.
    #[cfg(test)]
    fn flat(&self, depth_m: f64) -> Indentation {
        Indentation {
            force_n: depth_m * self.solve(|_| 1.0)[0],
            depth_m,
        }
    }

    /// Force and depth of a ball that has this contact radius.
    pub(super) fn ball(&self, radius_m: f64) -> Indentation {
        let ([flat, flat_edge], [round, round_edge]) = (self.solve(|_| 1.0), self.solve(|t| t * t));
        let depth_m = round_edge / flat_edge / radius_m;
        Indentation {
            force_n: depth_m * flat - round / radius_m,
            depth_m,
        }
    }

    /// Force, and φ at the edge, for g = 2/(π C) times a function of t.
    fn solve(&self, g: impl Fn(f64) -> f64) -> [f64; 2] {
        let scale = FRAC_2_PI * self.young_pa / (2.0 * (1.0 - self.poisson * self.poisson));
        let points: Vec<[f64; 2]> = gauss(POINTS, 0.0, self.contact_m);
        let matrix = DMatrix::from_fn(POINTS, POINTS, |i, j| {
            f64::from(i == j) - points[j][1] * self.kernel(points[i][0], points[j][0])
        });
        let right = DVector::from_fn(POINTS, |i, _| scale * g(points[i][0]));
        let phi = matrix.lu().solve(&right).unwrap_or(right * f64::NAN);
        let edge = self.contact_m;
        let sum = |of: &dyn Fn(f64) -> f64| -> f64 {
            let terms = points.iter().zip(phi.iter());
            terms.map(|(p, phi)| p[1] * phi * of(p[0])).sum()
        };
        [
            TAU * sum(&|_| 1.0),
            scale * g(edge) + sum(&|s| self.kernel(edge, s)),
        ]
    }

    fn kernel(&self, t: f64, s: f64) -> f64 {
        let width = FAR / INTERVALS as f64;
        let intervals = (0..INTERVALS).map(|i| i as f64 * width);
        let points = intervals.flat_map(|from| gauss(POINTS, from, from + width));
        let term = |[alpha, weight]: [f64; 2]| {
            let xi = alpha / self.thickness_m;
            weight * (1.0 - self.compliance(alpha)) * (xi * t).cos() * (xi * s).cos()
        };
        FRAC_2_PI / self.thickness_m * points.map(term).sum::<f64>()
    }

    /// M: compliance of the layer over that of a half space, for waves of number α/h.
    fn compliance(&self, alpha: f64) -> f64 {
        let k = 3.0 - 4.0 * self.poisson;
        let [sinh, cosh] = [(2.0 * alpha).sinh(), (2.0 * alpha).cosh()];
        (2.0 * k * sinh - 4.0 * alpha) / (2.0 * k * cosh + 4.0 * alpha * alpha + 1.0 + k * k)
    }
}

/// Points and weights of Gauss and Legendre.
fn gauss(n: usize, from: f64, to: f64) -> Vec<[f64; 2]> {
    let half = 0.5 * (to - from);
    let point = |i: usize| {
        let mut x = (PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
        let mut slope = 1.0;
        for _ in 0..8 {
            let (mut below, mut value) = (1.0, x);
            for k in 2..=n {
                let k = k as f64;
                (below, value) = (value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * below) / k);
            }
            slope = n as f64 * (x * value - below) / (x * x - 1.0);
            x -= value / slope;
        }
        [
            from + half * (1.0 + x),
            2.0 * half / ((1.0 - x * x) * slope * slope),
        ]
    };
    (0..n).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(contact_m: f64, poisson: f64) -> Layer {
        Layer {
            thickness_m: 1.0,
            contact_m,
            young_pa: 1.0,
            poisson,
        }
    }

    /// κ of Hayes et al. 1972, table 1: force on a flat punch over that on a half space, 2 E a d / (1 - ν²).
    #[test]
    fn flat_punch_has_the_published_factors() {
        let published = [
            (0.30, [1.207, 1.472, 1.784, 2.124, 2.480]),
            (0.40, [1.232, 1.542, 1.917, 2.337, 2.789]),
            (0.50, [1.281, 1.683, 2.211, 2.855, 3.609]),
        ];
        for (poisson, factors) in published {
            for (a, factor) in [0.2, 0.4, 0.6, 0.8, 1.0].into_iter().zip(factors) {
                let half_space = 2.0 * a / (1.0 - poisson * poisson);
                let computed = layer(a, poisson).flat(1.0).force_n / half_space;
                let error = computed / factor - 1.0;
                assert!(error.abs() < 3e-3, "{poisson} {a}: {computed} {factor}");
            }
        }
    }

    #[test]
    fn thick_layer_is_the_half_space_of_hertz() {
        let found = layer(1e-4, 0.3).ball(1.0);
        assert!((found.depth_m / 1e-8 - 1.0).abs() < 1e-3);
        assert!((found.force_n / (4.0 / 3.0 / 0.91 * 1e-12) - 1.0).abs() < 1e-3);
    }
}
