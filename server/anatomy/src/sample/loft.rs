//! Closed surfaces from cross-sections in polar form along an axis curve.
//!
//! A loft runs along Z from z0 to z1. At height z its section is the closed curve
//! c(z) + r(z, θ) (cos θ, sin θ), so its volume is ∫ ∫ r²/2 dθ dz whatever c is. Towards an end
//! r shrinks along a quarter of an ellipse, or the end is cut flat.
//!
//! Lengths in this folder are millimetres, as in tables of anatomy, and are converted to metres where a
//! [`Surface`] is made.

use std::f64::consts::{FRAC_PI_2, TAU};

use palpate_tissue::Vec3;

use crate::surface::{Surface, Unit};

/// A point of a section.
pub(super) type Point = [f64; 2];

/// Rings along the quarter of an ellipse that rounds an end. Reason: 11° each.
const RINGS_PER_END: usize = 8;

/// Shape of an end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum End {
    /// Cut flat.
    Flat,
    /// Cut flat, its rim rounded with this radius in mm.
    Fillet(f64),
    /// Rounded to a point over this length in mm.
    Dome(f64),
}

impl End {
    /// Length of axis in mm that it affects.
    fn length(self) -> f64 {
        match self {
            Self::Flat => 0.0,
            Self::Fillet(length) | Self::Dome(length) => length,
        }
    }

    /// The radius at distance `d` from the end, where it would be `r` without rounding.
    fn shrink(self, r: f64, d: f64) -> f64 {
        let quarter = |length: f64| {
            let u = ((length - d) / length).clamp(0.0, 1.0);
            (1.0 - u * u).sqrt()
        };
        match self {
            Self::Flat => r,
            Self::Fillet(length) => r - length * (1.0 - quarter(length)),
            Self::Dome(length) => r * quarter(length),
        }
    }
}

/// A lofted body; see the module docs for the letters.
pub(super) struct Loft<'a> {
    /// z0 and z1 in mm.
    pub(super) z: [f64; 2],
    /// Shape of its ends at z0 and at z1.
    pub(super) ends: [End; 2],
    /// c(z) in mm.
    pub(super) centre: Box<dyn Fn(f64) -> Point + 'a>,
    /// r(z, θ) in mm without the ends.
    pub(super) radius: Box<dyn Fn(f64, f64) -> f64 + 'a>,
}

impl Loft<'_> {
    /// r(z, θ) in mm with the ends.
    pub(super) fn radius_at(&self, z: f64, theta: f64) -> f64 {
        let r = (self.radius)(z, theta);
        let r = self.ends[0].shrink(r, z - self.z[0]);
        self.ends[1].shrink(r, self.z[1] - z).max(0.0)
    }

    /// Distance in mm from a point inside the section at z, without the ends, along the
    /// direction at angle `phi`, to the section's curve moved inward by `inset(θ)`.
    pub(super) fn distance(
        &self,
        z: f64,
        from: Point,
        phi: f64,
        inset: impl Fn(f64) -> f64,
    ) -> f64 {
        let c = (self.centre)(z);
        let outside = |s: f64| {
            let d = [
                from[0] + s * phi.cos() - c[0],
                from[1] + s * phi.sin() - c[1],
            ];
            let theta = d[1].atan2(d[0]);
            d[0].hypot(d[1]) > (self.radius)(z, theta) - inset(theta)
        };
        let mut inner = 0.0;
        let mut outer = 1.0;
        while !outside(outer) {
            inner = outer;
            outer *= 2.0;
        }
        // 30 halvings of a length below a metre: below the rounding of a file.
        for _ in 0..30 {
            let middle = 0.5 * (inner + outer);
            if outside(middle) {
                outer = middle;
            } else {
                inner = middle;
            }
        }
        inner
    }

    /// The closed surface with triangles of about `step_mm`, in metres.
    pub(super) fn surface(&self, step_mm: f64) -> Surface {
        let heights = self.heights(step_mm);
        let middle = 0.5 * (self.z[0] + self.z[1]);
        let widest = (0..16)
            .map(|k| (self.radius)(middle, TAU * f64::from(k) / 16.0))
            .fold(0.0, f64::max);
        let around = ((TAU * widest / step_mm).ceil() as usize).max(12);
        let mut rings = Rings {
            surface: Surface::default(),
            around,
        };
        // From the middle of one end, over the side, to the middle of the other.
        let (first, last) = (heights[0], heights[heights.len() - 1]);
        let cap = ((widest / step_mm).ceil() as usize).max(1);
        let mut previous = rings.pole(self.point(first, 0.0, 0.0));
        for k in 1..cap {
            if self.radius_at(first, 0.0) > 0.0 {
                let scale = k as f64 / cap as f64;
                previous = rings.add(previous, |theta| self.point(first, theta, scale));
            }
        }
        for &z in &heights {
            if self.radius_at(z, 0.0) > 0.0 {
                previous = rings.add(previous, |theta| self.point(z, theta, 1.0));
            }
        }
        for k in (1..cap).rev() {
            if self.radius_at(last, 0.0) > 0.0 {
                let scale = k as f64 / cap as f64;
                previous = rings.add(previous, |theta| self.point(last, theta, scale));
            }
        }
        rings.close(previous, self.point(last, 0.0, 0.0));
        rings.surface
    }

    /// Heights of the rings in mm, dense where an end is rounded.
    fn heights(&self, step_mm: f64) -> Vec<f64> {
        let [z0, z1] = self.z;
        let [low, high] = [z0 + self.ends[0].length(), z1 - self.ends[1].length()];
        // Equal angles along the quarter of the ellipse, as parts of the end's length.
        let quarter: Vec<f64> = (1..=RINGS_PER_END)
            .map(|k| 1.0 - (FRAC_PI_2 * k as f64 / RINGS_PER_END as f64).cos())
            .collect();
        let body = (((high - low) / step_mm).ceil() as usize).max(1);
        let mut heights = vec![z0];
        heights.extend(quarter.iter().map(|u| z0 + u * (low - z0)));
        heights.extend((1..body).map(|k| low + (high - low) * k as f64 / body as f64));
        heights.extend(quarter.iter().rev().map(|u| z1 - u * (z1 - high)));
        heights.push(z1);
        heights.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
        heights
    }

    /// A point of the section at z, drawn towards the axis by `scale`, in m.
    fn point(&self, z: f64, theta: f64, scale: f64) -> Vec3 {
        let c = (self.centre)(z);
        let r = scale * self.radius_at(z, theta);
        let mm = Unit::Millimetre.metres();
        Vec3::new(c[0] + r * theta.cos(), c[1] + r * theta.sin(), z) * mm
    }
}

/// A surface that grows ring by ring.
struct Rings {
    surface: Surface,
    around: usize,
}

/// The previous ring: one vertex, or `around` of them.
#[derive(Clone, Copy)]
enum Rim {
    Pole(u32),
    Ring(u32),
}

impl Rings {
    fn pole(&mut self, point: Vec3) -> Rim {
        self.surface.vertices.push(point);
        Rim::Pole(self.surface.vertices.len() as u32 - 1)
    }

    /// Adds a ring and joins it to the one before. Rings rise along Z or widen at the bottom, so
    /// that (this, next around, up) is counter-clockwise seen from outside.
    fn add(&mut self, before: Rim, point: impl Fn(f64) -> Vec3) -> Rim {
        let start = self.surface.vertices.len() as u32;
        let n = self.around as u32;
        let angle = |j: u32| TAU * f64::from(j) / f64::from(n);
        self.surface
            .vertices
            .extend((0..n).map(|j| point(angle(j))));
        for j in 0..n {
            let next = (j + 1) % n;
            match before {
                Rim::Pole(pole) => {
                    self.surface.triangles.push([pole, start + next, start + j]);
                }
                Rim::Ring(low) => {
                    self.surface
                        .triangles
                        .push([low + j, low + next, start + j]);
                    self.surface
                        .triangles
                        .push([low + next, start + next, start + j]);
                }
            }
        }
        Rim::Ring(start)
    }

    fn close(&mut self, last: Rim, point: Vec3) {
        let Rim::Ring(start) = last else { return };
        let n = self.around as u32;
        let Rim::Pole(pole) = self.pole(point) else {
            return;
        };
        for j in 0..n {
            self.surface
                .triangles
                .push([start + j, start + (j + 1) % n, pole]);
        }
    }
}

/// A smooth minimum of positive lengths, never above the smallest: (Σ dᵢ⁻ᵖ)^(-1/p), p = 6. Rays from one point,
/// limited in this way by every wall, give a body with rounded corners that stays inside all walls.
pub(super) fn rounded_min(lengths: impl IntoIterator<Item = f64>) -> f64 {
    const P: f64 = 6.0;
    lengths
        .into_iter()
        .map(|d| d.max(0.0).powf(-P))
        .sum::<f64>()
        .powf(-1.0 / P)
}

/// Distance from `from` along the direction at angle `phi` to the line through `on` whose normal
/// points at angle `normal`; infinite when the ray never reaches it.
pub(super) fn distance_to_line(from: Point, phi: f64, on: Point, normal: f64) -> f64 {
    let n = [normal.cos(), normal.sin()];
    let gap = (on[0] - from[0]) * n[0] + (on[1] - from[1]) * n[1];
    let speed = phi.cos() * n[0] + phi.sin() * n[1];
    if gap * speed > 0.0 {
        gap / speed
    } else {
        f64::INFINITY
    }
}

/// 0 below `from`, 1 above `to`, smooth between.
pub(super) fn smooth_step(from: f64, to: f64, x: f64) -> f64 {
    let u = ((x - from) / (to - from)).clamp(0.0, 1.0);
    u * u * (3.0 - 2.0 * u)
}

/// A bell of height 1 and half width `width` around `middle`.
pub(super) fn bell(x: f64, middle: f64, width: f64) -> f64 {
    (-((x - middle) / width).powi(2)).exp()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// ∫ ∫ r²/2 dθ dz in mm³.
    pub(in crate::sample) fn integral(loft: &Loft) -> f64 {
        let (nz, n) = (500, 120);
        let [z0, z1] = loft.z;
        let sum: f64 = (0..nz)
            .flat_map(|k| (0..n).map(move |j| (k, j)))
            .map(|(k, j)| {
                let z = z0 + (z1 - z0) * (f64::from(k) + 0.5) / f64::from(nz);
                loft.radius_at(z, TAU * f64::from(j) / f64::from(n)).powi(2)
            })
            .sum();
        0.5 * sum * (z1 - z0) / f64::from(nz) * TAU / f64::from(n)
    }

    fn oval(ends: [End; 2]) -> Loft<'static> {
        Loft {
            z: [-20.0, 50.0],
            ends,
            centre: Box::new(|z| [0.1 * z, 3.0 * (z / 20.0).sin()]),
            radius: Box::new(|z, theta| 20.0 + 0.1 * z + 2.0 * (3.0 * theta).cos()),
        }
    }

    #[test]
    fn loft_volume_is_the_integral_of_its_sections() {
        for ends in [
            [End::Flat; 2],
            [End::Fillet(6.0), End::Dome(15.0)],
            [End::Dome(12.0); 2],
        ] {
            let loft = oval(ends);
            let mut surface = loft.surface(1.0);
            let report = surface.check().unwrap();
            assert_eq!(report.warnings, Vec::<String>::new(), "{ends:?}");
            let error = report.volume_m3 * 1e9 / integral(&loft) - 1.0;
            assert!(error.abs() < 4e-3, "{ends:?}: {error}");
        }
    }

    #[test]
    fn loft_volume_converges_with_refinement() {
        let loft = oval([End::Fillet(6.0); 2]);
        let error = |step| (loft.surface(step).volume() * 1e9 / integral(&loft) - 1.0).abs();
        assert!(error(1.5) < error(6.0));
    }

    #[test]
    fn smooth_minimum_stays_below_every_length() {
        let lengths = [3.0, 5.0, f64::INFINITY, 4.0];
        let m = rounded_min(lengths);
        assert!(m < 3.0 && m > 2.5, "{m}");
    }
}
