//! The core of a rounded tool: a point, a line segment, or a rectangle.
//!
//! A tool is the set of points within its radius of its core: a ball, a needle with round ends, a plate with round
//! edges. The distance of a point to the tool is its distance to the core minus the radius.

use super::ball::Ball;
use super::{PLACES_MAX, Tool};
use crate::Vec3;

/// Maximum sampling points of a core; larger tools are sampled more coarsely. A needle of 0.25 m on a lattice of 4 mm
/// has 126.
const POINTS_MAX: usize = 256;
/// Maximum length of one contact patch in spacings (at least its radius).
const PLACE: f64 = 2.0;

/// The core of a tool in the scene: every `mid + s a + t b` with s and t from -1 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Core {
    pub(crate) mid: Vec3,
    pub(crate) a: Vec3,
    /// Across `a`; zero for a line.
    pub(crate) b: Vec3,
}

impl Core {
    /// The core of a tool in its pose.
    pub(crate) fn of(tool: &Tool) -> Self {
        if tool.is_ball() {
            return Self {
                mid: tool.centre,
                a: Vec3::zeros(),
                b: Vec3::zeros(),
            };
        }
        Self {
            mid: tool.centre + tool.turn * tool.form.mid,
            a: tool.turn * tool.form.half[0],
            b: tool.turn * tool.form.half[1],
        }
    }

    #[inline]
    pub(crate) fn is_point(&self) -> bool {
        self.a == Vec3::zeros() && self.b == Vec3::zeros()
    }

    /// Coordinates s and t of the core point nearest to `x`.
    pub(crate) fn nearest(&self, x: &Vec3) -> [f64; 2] {
        let v = x - self.mid;
        [&self.a, &self.b].map(|axis| {
            let square = axis.norm_squared();
            if square > 0.0 {
                (v.dot(axis) / square).clamp(-1.0, 1.0)
            } else {
                0.0
            }
        })
    }

    /// The point at these coordinates.
    #[inline]
    pub(crate) fn at(&self, [s, t]: [f64; 2]) -> Vec3 {
        if self.is_point() {
            return self.mid;
        }
        self.mid + self.a * s + self.b * t
    }

    /// Vector from the nearest core point to `x`.
    #[inline]
    pub(crate) fn towards(&self, x: &Vec3) -> Vec3 {
        if self.is_point() {
            return x - self.mid;
        }
        x - self.at(self.nearest(x))
    }

    /// Distance from its middle to its ends, in m.
    pub(crate) fn half_diagonal(&self) -> f64 {
        if self.is_point() {
            return 0.0;
        }
        (self.a.norm_squared() + self.b.norm_squared()).sqrt()
    }

    /// The ball around it.
    pub(crate) fn ball(&self) -> Ball {
        Ball {
            centre: self.mid,
            radius: self.half_diagonal(),
        }
    }

    /// Core points at most `pitch` apart, ends included; farther apart if there were more than [`POINTS_MAX`].
    pub(crate) fn points(&self, pitch: f64) -> Vec<[f64; 2]> {
        self.points_and_pitch(pitch).0
    }

    /// The same, and the largest distance between neighbours.
    pub(crate) fn points_and_pitch(&self, pitch: f64) -> (Vec<[f64; 2]>, f64) {
        let count = |pitch: f64| {
            [self.a, self.b].map(|axis| {
                let length = 2.0 * axis.norm();
                if length > 0.0 {
                    (length / pitch).ceil() as usize + 1
                } else {
                    1
                }
            })
        };
        let mut pitch = pitch;
        let mut n = count(pitch);
        while n[0] * n[1] > POINTS_MAX {
            pitch *= 1.25;
            n = count(pitch);
        }
        let along = |i: usize, n: usize| {
            if n < 2 {
                0.0
            } else {
                2.0 * i as f64 / (n - 1) as f64 - 1.0
            }
        };
        let all = (0..n[0]).flat_map(|i| (0..n[1]).map(move |j| (i, j)));
        let points = all.map(|(i, j)| [along(i, n[0]), along(j, n[1])]);
        (points.collect(), pitch)
    }

    /// Balls that cover every point within `reach` of the core.
    pub(crate) fn cover(&self, reach: f64) -> Vec<Ball> {
        // With this pitch every place is within 0.71 `pitch` of a point.
        let pitch = reach;
        let radius = if self.is_point() {
            reach
        } else {
            reach * (1.0 + std::f64::consts::FRAC_1_SQRT_2)
        };
        let points = self.points(pitch);
        if points.len() >= POINTS_MAX / 2 {
            let ball = self.ball();
            return vec![ball.wider(reach)];
        }
        let ball = |at: [f64; 2]| Ball {
            centre: self.at(at),
            radius,
        };
        points.into_iter().map(ball).collect()
    }

    /// Length times width of a tool in spacings, each at least one.
    pub(crate) fn spans(&self, spacing: f64) -> f64 {
        let of = |axis: &Vec3| (2.0 * axis.norm() / spacing).max(1.0);
        of(&self.a) * of(&self.b)
    }

    /// Number of contact patches along and across.
    pub(crate) fn contact_patches(&self, radius: f64, spacing: f64) -> [usize; 2] {
        let size = PLACE * radius.max(spacing);
        let wanted = [self.a, self.b].map(|axis| {
            let n = (2.0 * axis.norm() / size).ceil();
            (n as usize).clamp(1, PLACES_MAX)
        });
        let [mut n, mut m] = wanted;
        while n * m > PLACES_MAX {
            if n >= m {
                n -= 1;
            } else {
                m -= 1;
            }
        }
        [n, m]
    }
}

/// The patch with these coordinates, given the numbers of patches along and across.
pub(crate) fn patch_index([s, t]: [f64; 2], [n, m]: [usize; 2]) -> usize {
    let of = |x: f64, n: usize| (((x + 1.0) * 0.5 * n as f64) as usize).min(n - 1);
    of(s, n) * m + of(t, m)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn core() -> impl Strategy<Value = Core> {
        let v = || prop::array::uniform3(-0.1..0.1f64).prop_map(Vec3::from);
        (v(), v(), v(), 0..3).prop_map(|(mid, a, b, kind)| {
            let across = b - a * (a.dot(&b) / a.norm_squared());
            match kind {
                0 => Core {
                    mid,
                    a: Vec3::zeros(),
                    b: Vec3::zeros(),
                },
                1 => Core {
                    mid,
                    a,
                    b: Vec3::zeros(),
                },
                _ => Core { mid, a, b: across },
            }
        })
    }

    proptest! {
        #[test]
        fn nearest_point_of_a_core_is_the_minimum(
            core in core(), x in prop::array::uniform3(-0.3..0.3f64), s in -1.0..1.0f64, t in -1.0..1.0f64,
        ) {
            let x = Vec3::from(x);
            let nearest = core.towards(&x).norm();
            prop_assert!(nearest <= (x - core.at([s, t])).norm() + 1e-12);
        }

        #[test]
        fn cover_contains_all_points_within_reach(
            core in core(), reach in 0.002..0.05f64, s in -1.0..1.0f64, t in -1.0..1.0f64,
            off in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let off = Vec3::from(off);
            prop_assume!(off.norm() > 1e-3);
            let x = core.at([s, t]) + off.normalize() * (0.999 * reach);
            let held = core.cover(reach).iter().any(|b| (x - b.centre).norm() <= b.radius);
            prop_assert!(held);
        }

        #[test]
        fn points_lie_within_half_a_pitch_and_patches_are_bounded(core in core(), s in -1.0..1.0f64, t in -1.0..1.0f64) {
            let (points, pitch) = core.points_and_pitch(0.02);
            prop_assert!(!points.is_empty() && points.len() <= POINTS_MAX);
            // Only a core with too many points has them farther apart.
            prop_assert!(pitch == 0.02 || points.len() > POINTS_MAX / 2);
            let x = core.at([s, t]);
            let away = points.iter().map(|p| (core.at(*p) - x).norm()).fold(f64::MAX, f64::min);
            prop_assert!(away <= pitch * 0.71 + 1e-12);
            let n = core.contact_patches(0.002, 0.004);
            prop_assert!(n[0] * n[1] <= PLACES_MAX);
            prop_assert!(patch_index([s, t], n) < PLACES_MAX);
        }
    }
}
