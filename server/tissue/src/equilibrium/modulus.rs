//! Young's modulus and Poisson's ratio of a material in any direction.
//!
//! For springs of strength s(n) in all directions n the tensor is `C = 6 <s n n n n> + κ I I` (`springs.rs`, `law.rs`).
//! With S = C⁻¹ : aa, the strain per stress along a, Young's modulus is 1 / (aa : S), and Poisson's ratio, as the mean over
//! all directions across a, is (1 - tr S / (aa : S)) / 2.

use nalgebra::{Matrix6, Vector6};

use super::fibres::dyad;
use super::law::Elastic;
use crate::{Region, Vec3};

/// Pieces per edge of the cube around the sphere over which a material's tensor is integrated, with two Gauss
/// points in each. The sum is exact to five digits.
const PIECES: usize = 8;

/// Response of a material to tension along a direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tension {
    /// Young's modulus in Pa.
    pub young_pa: f64,
    /// Poisson's ratio: the mean over the directions across.
    pub poisson: f64,
}

impl Region {
    /// Response of its material to tension along a direction.
    pub fn tension_along(&self, direction: Vec3) -> Tension {
        let elastic = Elastic::asked(self);
        let mut stiffness = Matrix6::zeros();
        let mut weights = 0.0;
        // Points of the cube around the sphere; with r their distance, each stands for 1/r³ of the sphere.
        let points = 2 * PIECES;
        let along = |i: usize| {
            let off = [-1.0, 1.0][i % 2] / 3.0_f64.sqrt();
            ((2 * (i / 2) + 1) as f64 + off) / PIECES as f64 - 1.0
        };
        for axis in 0..3 {
            for i in 0..points * points {
                let mut d = Vec3::ith(axis, 1.0);
                d[(axis + 1) % 3] = along(i % points);
                d[(axis + 2) % 3] = along(i / points);
                let r = d.norm();
                let weight = 1.0 / (r * r * r);
                let dyad = dyad(&(d / r));
                weights += weight;
                stiffness += dyad * dyad.transpose() * (weight * elastic.fibre_factor(&d));
            }
        }
        stiffness *= 6.0 * elastic.spring_pa / weights;
        let unit = Vector6::new(1.0, 1.0, 1.0, 0.0, 0.0, 0.0);
        stiffness += unit * unit.transpose() * elastic.bulk_pa;
        let pulled = dyad(&direction);
        let of_material = Tension {
            young_pa: self.material.young_pa,
            poisson: self.material.poisson,
        };
        stiffness.try_inverse().map_or(of_material, |compliance| {
            let strain = compliance * pulled;
            let along = pulled.dot(&strain);
            Tension {
                young_pa: 1.0 / along,
                poisson: 0.5 * (1.0 - unit.dot(&strain) / along),
            }
        })
    }
}
