//! The length law (Lin 2007, eq. 3.4): force law and moduli of the springs of a cell.
//!
//! With `d0 = X_j - X_i` the spring at rest, `δ = u_j - u_i` and d = d0 + δ, the force on i is
//! k (|d| - l0) d/|d|. The difference of two nearly equal lengths would lose all digits of a small
//! strain, so it is written as
//!
//! ```text
//! q = |d|² - l0² = δ·(2 d0 + δ)          |d| - l0 = q / (|d| + l0)
//! ```
//!
//! which is exact in relative terms, zero at rest to the last bit, and lets the arithmetic run in
//! eight lanes of f32 on differences that were taken in f64.
//!
//! # The volume term
//!
//! Springs alone are a material of Poisson's ratio 1/4. Beside them stands, per cell, the energy
//! ½ κ V0 (J - 1)² with J the determinant of the cell's mean edges over that at rest. With
//! μ = E/(2(1+ν)) and λ = Eν/((1+ν)(1-2ν)) the springs carry μ (C12 = C44 = μ) and κ = λ - μ the rest.
//! J - 1 is the change of the determinant over that at rest, or over [`LENGTH_FLOOR`](crate::springs::LENGTH_FLOOR) of a
//! cube's for flatter cells. Otherwise the volume term of a flat cell stiffens while its springs soften, and the smoother,
//! whose blocks bound that stiffness, hardly moves nodes that belong to this cell alone.
//!
//! # The guard
//!
//! A spring does not know its orientation: under a deep press a node can pass its neighbour and stay folded, in a
//! spurious equilibrium. The seed's guard is the neighbouring bounding box (eq. 3.7): a node stays between its
//! neighbours along the axes of the rest state. As a force (reconstructed), with p = d·d0 / l0², one at rest and
//! negative for a folded spring:
//!
//! ```text
//! guard on i = -G k (θ - p) d0     while p < θ
//! ```
//!
//! It is the gradient of a convex energy, so it adds no equilibria; with G θ > 1 it outweighs the spring at any fold.
//! It is zero until a spring is compressed or turned to θ of its length along d0, which no moderate press does. It
//! limits the rotation of a flap against its rest state to about acos θ = 73°.
//!
//! # Extreme springs
//!
//! A spring compressed below `α_min` l0 or extended beyond `α_max` l0 is extreme (Lin 2007, section 3.5, fig. 3.11): it
//! becomes inextensible without breaking, and transmits the load. The seed accumulates forces over rigid clusters by
//! recursion, which can cycle. Here (reconstructed) an extreme spring is S times stiffer beyond its limit, so that the
//! equilibrium transmits the force through the cluster. A thirtyfold step in stiffness is hard to solve: with a limit
//! of 0.8 iterates oscillate. In materials that bottom out, a compressed spring therefore has an energy that stiffens
//! over a part of its length and by a smaller factor (`stabilisation.rs`), because stiff rods buckle. Iterates that
//! decrease an energy can not cycle.
//!
//! # Deep presses
//!
//! Springs compressed to half their length buckle sideways, and a lattice of them softens as it flattens. The
//! stabilisation energy of compressed springs is in `stabilisation.rs`, the energy of collapsing cells in `corners.rs`.
//! Both are zero up to a tenth of strain, and leave Young's modulus, shear modulus and Poisson's ratio unchanged.
//!
//! # The tangent
//!
//! The tangent of one spring is k [n nᵀ + s (I - n nᵀ)] with s = 1 - l0/|d|. A compressed spring has s < 0, which would
//! make the block indefinite under a deep press. A spring shorter than the moves of its ends turns within one step, so
//! its tangent does not predict its force. So s has a floor σ(l0/Δd), small for springs of the lattice's own length and
//! one for short ones: k I bounds the length law from above in any direction.

use super::fibres;
use crate::{Material, Region, Vec3};

/// Symmetric 3x3 block: xx, yy, zz, xy, xz, yz.
pub(crate) type Symmetric = [f64; 6];

/// θ: part of its rest length that a spring keeps along its rest direction before the guard pushes.
pub(crate) const GUARDED: f32 = 0.3;
/// G: stiffness of the guard in parts of the spring's; G θ must be above one.
pub(crate) const GUARD: f32 = 6.0;
/// S: stiffness of a spring beyond its limits, in parts of its own.
pub(crate) const EXTREME: f32 = 30.0;

/// Floor of s for springs as long as the lattice's own.
pub(crate) const SIDEWAYS: f32 = 0.1;
/// Length in spacings below which a spring is assumed to turn freely; its floor is one.
pub(crate) const SHORT: f32 = 0.5;
/// Length in spacings from which on the floor is [`SIDEWAYS`].
pub(crate) const LONG: f32 = 0.9;

/// The floor σ of a spring of rest length `l0` on a lattice of spacing Δd, given as 1/Δd.
#[inline(always)]
pub(crate) fn sideways(l0: f32, per_spacing: f32) -> f32 {
    let t = (l0 * per_spacing - SHORT) / (LONG - SHORT);
    let t = if t < 0.0 { 0.0 } else { t };
    let t = if t > 1.0 { 1.0 } else { t };
    1.0 + t * (SIDEWAYS - 1.0)
}

/// Force curve of a spring.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Curve {
    /// Exponent b of F = k l0 (exp(b ε) - 1)/b; zero for a linear law.
    pub(crate) stiffening: f32,
    /// `α_min` and `α_max`: relative lengths from which a spring is extreme.
    pub(crate) limits: [f32; 2],
    /// Whether compressed springs are stabilised and collapsing corners harden (`stabilisation.rs`, `corners.rs`).
    pub(crate) held: bool,
}

impl Curve {
    /// The curve of a material.
    pub(crate) fn of(material: &Material) -> Self {
        Self {
            stiffening: material.stiffening as f32,
            limits: [
                material.compress_limit as f32,
                material.stretch_limit as f32,
            ],
            held: material.bottoms_out,
        }
    }
}

/// Moduli of the springs and the volume term of one region.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Elastic {
    /// Young's modulus of the springs in Pa: 2.5 μ.
    pub(crate) spring_pa: f64,
    /// κ = λ - μ in Pa.
    pub(crate) bulk_pa: f64,
    fibre: Vec3,
    /// β of 1 + β cos⁴.
    fibre_strength: f64,
}

impl Elastic {
    /// Moduli of a region for the thirteen directions of a lattice's springs.
    pub(crate) fn of(region: &Region) -> Self {
        Self::with(region, |fibre| {
            fibres::in_a_lattice(region.material.fibre_ratio, fibre)
        })
    }

    /// Moduli of a region for springs in all directions, as specified by the material.
    pub(super) fn asked(region: &Region) -> Self {
        Self::with(region, |_| {
            fibres::in_all_directions(region.material.fibre_ratio)
        })
    }

    fn with(region: &Region, strength: impl Fn(&Vec3) -> (f64, f64)) -> Self {
        let (young, nu) = (region.material.young_pa, region.material.poisson);
        let shear = young / (2.0 * (1.0 + nu));
        let lame = young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu));
        let fibre = Vec3::from(region.fibre);
        let (fibre_strength, scale) = if fibre == Vec3::zeros() {
            (0.0, 1.0)
        } else {
            strength(&fibre)
        };
        Self {
            spring_pa: 2.5 * shear * scale,
            bulk_pa: (lame - shear).max(0.0),
            fibre,
            fibre_strength,
        }
    }

    /// μ in Pa.
    pub(crate) fn shear_pa(&self) -> f64 {
        self.spring_pa / 2.5
    }

    /// Whether the stiffness of springs depends on their directions.
    pub(crate) fn has_fibres(&self) -> bool {
        self.fibre_strength != 0.0
    }

    /// Factor of a spring in direction `d` by its angle to the fibres.
    pub(crate) fn fibre_factor(&self, d: &Vec3) -> f64 {
        let square = d.norm_squared();
        if self.fibre_strength == 0.0 || square == 0.0 {
            return 1.0;
        }
        let cos = d.dot(&self.fibre);
        1.0 + self.fibre_strength * (cos * cos / square) * (cos * cos / square)
    }
}

/// Inverse of a symmetric block, regularised by a fraction of its trace.
pub(crate) fn invert(m: &Symmetric) -> Symmetric {
    let guard = 1e-5 * (m[0] + m[1] + m[2]) + f64::MIN_POSITIVE;
    let (a, b, c) = (m[0] + guard, m[1] + guard, m[2] + guard);
    let (d, e, f) = (m[3], m[4], m[5]);
    let (xx, xy, xz) = (b * c - f * f, e * f - d * c, d * f - b * e);
    let det = a * xx + d * xy + e * xz;
    let inverse = 1.0 / det;
    if !inverse.is_finite() || inverse <= 0.0 {
        let t = 3.0 / (a + b + c);
        let t = if t.is_finite() { t } else { 0.0 };
        return [t, t, t, 0.0, 0.0, 0.0];
    }
    [
        xx * inverse,
        (a * c - e * e) * inverse,
        (a * b - d * d) * inverse,
        xy * inverse,
        xz * inverse,
        (d * e - a * f) * inverse,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_undoes_the_block() {
        let m = [5.0, 3.0, 4.0, 1.0, -0.5, 0.7];
        let v = Vec3::new(0.3, -1.0, 2.0);
        let apply = |m: &Symmetric, v: &Vec3| {
            Vec3::new(
                m[0] * v.x + m[3] * v.y + m[4] * v.z,
                m[3] * v.x + m[1] * v.y + m[5] * v.z,
                m[4] * v.x + m[5] * v.y + m[2] * v.z,
            )
        };
        let back = apply(&invert(&m), &apply(&m, &v));
        assert!((back - v).norm() < 1e-3, "{back}");
    }
}
