//! Making up positions between and beyond samples.
//!
//! A Verlet step of length h with acceleration a (Lin 2007, figs 6.8 and 6.9; the rule is
//! reconstructed)
//!
//! ```text
//! x(t+h) = 2 x(t) - x(t-h) + a h²
//! ```
//!
//! is, for any s beyond the newest sample x1 with xm one window before it,
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

/// A vector in metres, or metres per second, or per second squared.
pub type Vec3 = [f64; 3];

/// The window w in seconds.
pub const WINDOW_S: f64 = 0.010;

/// No hand accelerates faster, m/s²; what seems to is noise.
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
    let size = a.iter().map(|c| c * c).sum::<f64>().sqrt();
    let scale = if size > ACCELERATION_MAX {
        ACCELERATION_MAX / size
    } else {
        1.0
    };
    a.map(|c| c * scale)
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
        fn a_parabola_is_continued_exactly(
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
        let got = hermite(cubic(0.1), cubic(0.4), v(0.1), v(0.4), 0.2);
        for (got, want) in got.iter().zip(cubic(0.2).x) {
            assert!((got - want).abs() < 1e-12);
        }
    }
}
