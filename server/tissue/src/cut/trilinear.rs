//! The trilinear map of a cell, `x(ξ) = Σ N_c(ξ) x_c` with ξ in the unit cube, and its inverse by
//! Newton's method.

use nalgebra::Matrix3;

use crate::Vec3;

/// Newton steps; a parallelepiped needs one, a sound cell four.
const STEPS: usize = 12;

/// Shares `N_c(ξ)` of the corners.
pub(crate) fn weights(local: &Vec3) -> [f64; 8] {
    std::array::from_fn(|c| {
        (0..3)
            .map(|a| {
                if c >> a & 1 == 1 {
                    local[a]
                } else {
                    1.0 - local[a]
                }
            })
            .product()
    })
}

/// The point at ξ.
pub(crate) fn point(corners: &[Vec3; 8], local: &Vec3) -> Vec3 {
    corners.iter().zip(weights(local)).map(|(x, w)| x * w).sum()
}

/// The derivative of the point by ξ.
pub(crate) fn gradient(corners: &[Vec3; 8], local: &Vec3) -> Matrix3<f64> {
    let mut sum = Matrix3::zeros();
    for (c, x) in corners.iter().enumerate() {
        let n = Vec3::from_fn(|a, _| {
            (0..3)
                .map(|b| match (a == b, c >> b & 1 == 1) {
                    (true, high) => {
                        if high {
                            1.0
                        } else {
                            -1.0
                        }
                    }
                    (false, true) => local[b],
                    (false, false) => 1.0 - local[b],
                })
                .product()
        });
        sum += x * n.transpose();
    }
    sum
}

/// The ξ of a point, inside the cell or not; `None` when the cell is too distorted to tell.
pub(crate) fn invert(corners: &[Vec3; 8], to: &Vec3) -> Option<Vec3> {
    let mut local = Vec3::repeat(0.5);
    for _ in 0..STEPS {
        let miss = to - point(corners, &local);
        let step = gradient(corners, &local).try_inverse()? * miss;
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        // Far outside, the map folds; small steps keep to the branch of the cell itself.
        local += step.map(|v| v.clamp(-2.0, 2.0));
        if step.amax() < 1e-12 {
            return Some(local);
        }
    }
    let miss = (to - point(corners, &local)).norm();
    let size = (corners[7] - corners[0]).norm();
    (miss < 1e-6 * size).then_some(local)
}
