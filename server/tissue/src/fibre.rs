//! The direction of a region's fibres, computed once when the model is made.

use crate::{FibreAxis, Model, Vec3};

/// Squarings of the tensor. Each doubles the exponent of a power iteration, so that 40 of them part
/// axes whose moments differ by no more than rounding does.
const SQUARINGS: usize = 40;

impl Model {
    /// Sets every region's fibre direction from its material: zero where the material is isotropic, else a unit
    /// vector. The builder calls this; so must a program that assembles a model by hand or changes its
    /// materials.
    pub fn resolve_fibres(&mut self) {
        for index in 0..self.regions.len() {
            let material = &self.regions[index].material;
            let fibre = if material.fibre_ratio == 1.0 {
                Vec3::zeros()
            } else {
                match material.fibre_axis {
                    FibreAxis::Long => self.long_axis(index),
                    FibreAxis::Given(axis) => unit(axis.into()),
                }
            };
            self.regions[index].fibre = fibre.into();
        }
    }

    /// The principal axis of the middles of a region's cells, as a unit vector whose largest component is
    /// positive. For a region without a long axis (a ball, a cube) the result is arbitrary but reproducible.
    /// For a region without cells it is z.
    fn long_axis(&self, region: usize) -> Vec3 {
        let middles = || {
            let cells = self.cells.iter().filter(|c| c.region.index() == region);
            cells.map(|c| {
                let sum: Vec3 = c.corners.iter().map(|&n| self.nodes[n as usize]).sum();
                sum / 8.0
            })
        };
        let count = middles().count().max(1) as f64;
        let mean = middles().sum::<Vec3>() / count;
        let mut tensor = [[0.0; 3]; 3];
        for middle in middles() {
            let r = middle - mean;
            for i in 0..3 {
                for j in 0..3 {
                    tensor[i][j] += r[i] * r[j];
                }
            }
        }
        largest_axis(tensor)
    }
}

/// The eigenvector of the largest eigenvalue of a symmetric matrix that is not negative anywhere,
/// by repeated squaring: products and sums in a fixed order, the same bits on every machine.
fn largest_axis(mut m: [[f64; 3]; 3]) -> Vec3 {
    for _ in 0..SQUARINGS {
        let trace = m[0][0] + m[1][1] + m[2][2];
        if !(trace.is_finite() && trace > 0.0) {
            return Vec3::z();
        }
        let scaled = m.map(|row| row.map(|v| v / trace));
        for i in 0..3 {
            for j in 0..3 {
                m[i][j] = (0..3).map(|k| scaled[i][k] * scaled[k][j]).sum();
            }
        }
    }
    // All columns are multiples of the eigenvector now; the one with the largest diagonal is the most accurate.
    let surest = (1..3).fold(0, |best, i| if m[i][i] > m[best][best] { i } else { best });
    let axis = unit(Vec3::from(m[surest]));
    if axis[axis.iamax()] < 0.0 {
        -axis
    } else {
        axis
    }
}

/// The unit vector of a direction; z if the direction is zero.
fn unit(v: Vec3) -> Vec3 {
    // Scaled first, so that the squares of very small and very large components stay numbers.
    let scaled = v / v.amax();
    let length = (scaled.x * scaled.x + scaled.y * scaled.y + scaled.z * scaled.z).sqrt();
    if length.is_finite() && length > 0.0 {
        scaled / length
    } else {
        Vec3::z()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Material, block};

    fn fibred(axis: FibreAxis) -> Material {
        Material {
            fibre_ratio: 3.0,
            fibre_axis: axis,
            ..Material::default()
        }
    }

    #[test]
    fn long_axis_rotates_with_the_bar() {
        let mut model = block([4, 30, 6], 0.002, &fibred(FibreAxis::Long), 1);
        assert!((Vec3::from(model.regions[1].fibre) - Vec3::y()).norm() < 1e-12);
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, 1.1, -0.7);
        for p in &mut model.nodes {
            *p = turn * *p + Vec3::new(0.3, -2.0, 0.1);
        }
        model.resolve_fibres();
        let found = Vec3::from(model.regions[1].fibre);
        assert!((found.dot(&(turn * Vec3::y())).abs() - 1.0).abs() < 1e-9);
        assert!((found.norm() - 1.0).abs() < 1e-12);
        assert!(found[found.iamax()] > 0.0);
    }

    #[test]
    fn isotropic_material_has_no_fibres() {
        let model = block([3, 3, 3], 0.002, &Material::default(), 1);
        assert!(model.regions.iter().all(|r| r.fibre == [0.0; 3]));
    }

    #[test]
    fn given_direction_is_normalised() {
        for scale in [1.0, 1e-200, 1e200] {
            let axis = [0.0, 3.0 * scale, -4.0 * scale];
            let model = block([2, 2, 2], 0.002, &fibred(FibreAxis::Given(axis)), 1);
            let off = Vec3::from(model.regions[1].fibre) - Vec3::new(0.0, 0.6, -0.8);
            assert!(off.norm() < 1e-15, "{off:?}");
        }
    }

    #[test]
    fn axis_of_a_cube_is_reproducible() {
        let axis = || block([4, 4, 5], 0.002, &fibred(FibreAxis::Long), 1).regions[1].fibre;
        assert_eq!(axis(), axis());
        assert!((Vec3::from(axis()).norm() - 1.0).abs() < 1e-12);
    }
}
