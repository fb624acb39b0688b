//! Interpolation between samples and extrapolation beyond them.
//!
//! A Verlet step of length h with acceleration a (Lin 2007, figs 6.8 and 6.9; the rule is
//! reconstructed)
//!
//! ```text
//! x(t+h) = 2 x(t) - x(t-h) + a h²
//! ```
//!
//! gives, for any s beyond the newest sample x1 with xm one window before it,
//!
//! ```text
//! EXTRAPOLATE   x(s) = x1 + (x1 - xm)/h1 · s + a/2 · s (s + h1)
//! INTERPOLATE   x(u) = (1-u) x0 + u x1 - u(1-u) T²/6 · [a0 (2-u) + a1 (1+u)]
//! ```
//!
//! The second is the cubic with x0, x1 and the accelerations a0, a1 at the ends of a gap T. An
//! acceleration from neighbouring samples of a 1 kHz stream multiplies their noise by √6/h²; from
//! samples one window w = 10 ms apart by a hundredth of it. Samples need not be evenly spaced:
//!
//! ```text
//! a = 2 [ (x1 - xm)/h1 - (xm - x0)/h2 ] / (h1 + h2)       the second divided difference
//! ```
//!
//! # Beyond the newest sample: least squares and a fading acceleration
//!
//! Three samples 10 ms apart reach 20 ms back and discard all other samples of a 1 kHz stream. Two
//! errors are extrapolated. The parabola's error for the hand's third derivative j grows with the reach
//! W. The noise σ of samples, here the rounding to 0.0125 mm on the wire, falls with the number n of
//! samples. For a least-squares parabola over evenly spaced samples (its residual of a cubic is
//! Legendre's third polynomial; its coefficients at the end of the window have the variances of the
//! inverse normal equations for large n)
//!
//! ```text
//! j (s + 0.11 W) (s + 0.50 W) (s + 0.89 W) / 6            three samples:  j s (s + W/2) (s + W) / 6
//! σ_v = √192 σ / (W √n)        σ_a = √720 σ / (W² √n)
//! ```
//!
//! With W = 15 ms at 1 kHz the velocity noise is that of three samples over 20 ms (231 σ/s against 255),
//! and at s = 10 ms the error for j is four fifths of theirs. Between 12 and 18 ms the sum is flat;
//! [`FIT_S`] is 15 ms.
//!
//! An acceleration predicts little after 50 ms: physiological tremor, 8 to 12 Hz, has reversed by then,
//! and a parabola continues. The acceleration therefore fades as exp(-s/τ) (the target model of Singer
//! 1970):
//!
//! ```text
//! EXTRAPOLATE   x(s) = x1 + v s + a τ² (exp(-s/τ) - 1 + s/τ)      = x1 + v s + a s²/2 - …   for s << τ
//! ```
//!
//! τ = 25 ms, a quarter of a tremor's period. This reduces the acceleration's share by an eighth at 10
//! ms and by two fifths at 50 ms. Least squares and fading are reconstructions, not the source's.

use nalgebra::{Matrix3, Vector3};

/// A vector in metres, or metres per second, or per second squared.
pub type Vec3 = [f64; 3];

/// The window w in seconds.
pub const WINDOW_S: f64 = 0.010;

/// The window of the extrapolated parabola, seconds.
pub const FIT_S: f64 = 0.015;

/// Time constant of the fading acceleration beyond the newest sample, seconds.
pub const FADES_S: f64 = 0.025;

/// The largest correction of the newest sample by a fit, metres: two steps of the wire. Larger residuals
/// are motion, not noise.
const NOISE_MAX_M: f64 = 2.5e-5;

/// The largest acceleration of a hand, m/s²; larger values are noise.
pub const ACCELERATION_MAX: f64 = 50.0;

/// A sample's position and time in seconds, relative to any origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Knot {
    /// Seconds.
    pub t: f64,
    /// Metres.
    pub x: Vec3,
}

/// Component by component.
pub(crate) fn map2(a: Vec3, b: Vec3, f: impl Fn(f64, f64) -> f64) -> Vec3 {
    [f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2])]
}

/// The slope from `a` to `b`.
pub fn velocity(a: Knot, b: Knot) -> Vec3 {
    let h = (b.t - a.t).max(1e-6);
    map2(a.x, b.x, |a, b| (b - a) / h)
}

/// The second divided difference of three samples in the order of time, limited to
/// [`ACCELERATION_MAX`].
pub fn acceleration(k0: Knot, km: Knot, k1: Knot) -> Vec3 {
    let span = (k1.t - k0.t).max(2e-6);
    let a = map2(velocity(k0, km), velocity(km, k1), |before, after| {
        2.0 * (after - before) / span
    });
    limited(a, ACCELERATION_MAX)
}

/// The vector limited to length `most`.
fn limited(a: Vec3, most: f64) -> Vec3 {
    let size = a.iter().map(|c| c * c).sum::<f64>().sqrt();
    if size > most {
        a.map(|c| c * most / size)
    } else {
        a
    }
}

/// Position, velocity and acceleration at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Metres.
    pub x: Vec3,
    /// Metres per second.
    pub v: Vec3,
    /// Metres per second squared.
    pub a: Vec3,
}

/// The least-squares parabola through `knots`, at the moment of `here`, one of them. `None` for fewer
/// than three distinct moments.
pub fn fit(knots: impl Iterator<Item = Knot>, here: Knot) -> Option<Fit> {
    let mut normal = Matrix3::zeros();
    let mut right = Matrix3::zeros();
    for knot in knots {
        // In units of the window and relative to the sample, so that no sum is large and no digits are
        // lost.
        let t = (knot.t - here.t) / FIT_S;
        let row = Vector3::new(1.0, t, 0.5 * t * t);
        normal += row * row.transpose();
        right += row * Vector3::from(map2(knot.x, here.x, |x, o| x - o)).transpose();
    }
    // Two moments make the matrix singular; a nearly singular one would amplify noise.
    if normal.determinant() < 1e-9 {
        return None;
    }
    let solved = normal.cholesky()?.solve(&right);
    let row = |i: usize, scale: f64| -> Vec3 { std::array::from_fn(|k| solved[(i, k)] / scale) };
    Some(Fit {
        x: map2(here.x, limited(row(0, 1.0), NOISE_MAX_M), |x, d| x + d),
        v: row(1, FIT_S),
        a: limited(row(2, FIT_S * FIT_S), ACCELERATION_MAX),
    })
}

impl Fit {
    /// EXTRAPOLATE: position and velocity `s` seconds on, the acceleration fading.
    pub fn on(&self, s: f64) -> (Vec3, Vec3) {
        let left = (-s / FADES_S).exp();
        let share = FADES_S * FADES_S * (left - 1.0 + s / FADES_S);
        let straight = map2(self.x, self.v, |x, v| x + v * s);
        (
            map2(straight, self.a, |x, a| x + a * share),
            map2(self.v, self.a, |v, a| v + a * FADES_S * (1.0 - left)),
        )
    }
}

/// EXTRAPOLATE: `s` seconds beyond `k1`, with `km` before it and the acceleration `a`.
pub fn extrapolate(km: Knot, k1: Knot, a: Vec3, s: f64) -> Vec3 {
    let h1 = (k1.t - km.t).max(1e-6);
    let straight = map2(km.x, k1.x, |m, x1| x1 + (x1 - m) / h1 * s);
    map2(straight, a, |x, a| x + 0.5 * a * s * (s + h1))
}

/// INTERPOLATE: at `t` between `k0` and `k1`, with the accelerations there.
pub fn interpolate(k0: Knot, k1: Knot, a0: Vec3, a1: Vec3, t: f64) -> Vec3 {
    let gap = (k1.t - k0.t).max(1e-6);
    let u = ((t - k0.t) / gap).clamp(0.0, 1.0);
    let line = map2(k0.x, k1.x, |x0, x1| (1.0 - u) * x0 + u * x1);
    let bend = map2(a0, a1, |a0, a1| a0 * (2.0 - u) + a1 * (1.0 + u));
    map2(line, bend, |x, b| x - u * (1.0 - u) * gap * gap / 6.0 * b)
}

/// The cubic with the velocities `v0`, `v1` at its ends (Hermite).
pub fn hermite(k0: Knot, k1: Knot, v0: Vec3, v1: Vec3, t: f64) -> Vec3 {
    let gap = (k1.t - k0.t).max(1e-6);
    let u = ((t - k0.t) / gap).clamp(0.0, 1.0);
    let (u2, u3) = (u * u, u * u * u);
    let ends = map2(k0.x, k1.x, |x0, x1| {
        (2.0 * u3 - 3.0 * u2 + 1.0) * x0 + (3.0 * u2 - 2.0 * u3) * x1
    });
    let slopes = map2(v0, v1, |v0, v1| {
        gap * ((u3 - 2.0 * u2 + u) * v0 + (u3 - u2) * v1)
    });
    map2(ends, slopes, |a, b| a + b)
}

/// The end of the cubic of two samples and their velocities, for extrapolation as a [`Fit`].
/// Extrapolating the cubic itself amplifies its noisy third derivative: 50 ms ahead its error was 1.3
/// mm, that of a straight line 0.4 mm.
pub fn end_of_cubic((k0, v0): (Knot, Vec3), (k1, v1): (Knot, Vec3)) -> Fit {
    let gap = (k1.t - k0.t).max(1e-6);
    let chord = velocity(k0, k1);
    let slopes = map2(v0, v1, |v0, v1| 2.0 * v0 + 4.0 * v1);
    Fit {
        x: k1.x,
        v: v1,
        a: limited(
            map2(slopes, chord, |s, c| (s - 6.0 * c) / gap),
            ACCELERATION_MAX,
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parabola(c: [f64; 3], t: f64) -> Knot {
        let x = c[0] + c[1] * t + 0.5 * c[2] * t * t;
        Knot {
            t,
            x: [x, -x, 2.0 * x],
        }
    }

    fn cubic(t: f64) -> Knot {
        Knot {
            t,
            x: [t * t * t, 1.0 - t, 0.5 * t * t],
        }
    }

    proptest! {
        #[test]
        fn parabola_is_extrapolated_exactly(
            c in [-0.1_f64..0.1, -0.3_f64..0.3, -10.0_f64..10.0],
            h1 in 0.001_f64..0.02, h2 in 0.001_f64..0.02, s in 0.0_f64..0.05,
        ) {
            let (k0, km, k1) = (parabola(c, -h1 - h2), parabola(c, -h1), parabola(c, 0.0));
            let got = extrapolate(km, k1, acceleration(k0, km, k1), s);
            for (got, want) in got.iter().zip(parabola(c, s).x) {
                prop_assert!((got - want).abs() < 1e-9);
            }
        }
    }

    proptest! {
        #[test]
        fn fit_recovers_a_parabola_from_any_sampling(
            c in [-0.1_f64..0.1, -0.3_f64..0.3, -10.0_f64..10.0],
            gaps in prop::collection::vec(0.001_f64..0.01, 3..20),
        ) {
            let mut t = 0.0;
            let mut knots = vec![parabola(c, 0.0)];
            for gap in gaps {
                t -= gap;
                knots.push(parabola(c, t));
            }
            let fit = fit(knots.iter().copied(), knots[0]).unwrap();
            prop_assert!((fit.x[0] - c[0]).abs() < 1e-8);
            prop_assert!((fit.v[0] - c[1]).abs() < 1e-5, "{fit:?}");
            prop_assert!((fit.a[0] - c[2]).abs() < 1e-2, "{fit:?}");
        }

        #[test]
        fn velocity_is_the_derivative_of_the_extrapolation(
            v in -0.3_f64..0.3, a in -10.0_f64..10.0, s in 0.0_f64..0.1,
        ) {
            let fit = Fit { x: [0.0; 3], v: [v; 3], a: [a; 3] };
            let h = 1e-6;
            let slope = (fit.on(s + h).0[0] - fit.on(s - h).0[0]) / (2.0 * h);
            prop_assert!((slope - fit.on(s).1[0]).abs() < 1e-6);
            // Never more than the parabola would, and for a millisecond the same.
            prop_assert!((fit.on(s).0[0] - v * s).abs() <= 0.5 * a.abs() * s * s + 1e-12);
            prop_assert!((fit.on(1e-3).0[0] - v * 1e-3 - 0.5e-6 * a).abs() < 1e-8 * a.abs().max(1.0));
        }
    }

    #[test]
    fn two_samples_have_no_acceleration() {
        let k = |t: f64| Knot { t, x: [t; 3] };
        assert!(fit([k(0.0), k(-0.01)].into_iter(), k(0.0)).is_none());
    }

    #[test]
    fn a_cubic_with_its_accelerations_is_interpolated_exactly() {
        let (k0, k1) = (cubic(0.1), cubic(0.4));
        let a = |t: f64| [6.0 * t, 0.0, 1.0];
        for i in 0..=10 {
            let t = 0.1 + 0.03 * f64::from(i);
            let got = interpolate(k0, k1, a(0.1), a(0.4), t);
            for (got, want) in got.iter().zip(cubic(t).x) {
                assert!((got - want).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_cubic_with_its_velocities_is_interpolated_exactly() {
        let v = |t: f64| [3.0 * t * t, -1.0, t];
        let end = end_of_cubic((cubic(0.1), v(0.1)), (cubic(0.4), v(0.4)));
        assert!((end.a[0] - 6.0 * 0.4).abs() < 1e-9 && (end.a[2] - 1.0).abs() < 1e-9);
        let got = hermite(cubic(0.1), cubic(0.4), v(0.1), v(0.4), 0.2);
        for (got, want) in got.iter().zip(cubic(0.2).x) {
            assert!((got - want).abs() < 1e-12);
        }
    }
}
