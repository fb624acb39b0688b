//! Points of the deformed surface: triangles, nearest points, normals.

use super::ball::Ball;
use super::surface_index::SurfaceIndex;
use crate::nearest::{Feature, nearest_feature};
use crate::{Topology, Vec3};

/// The deformed outer surface for searches.
#[derive(Clone, Copy)]
pub(crate) struct Surface<'a> {
    pub(crate) topology: &'a Topology,
    /// Displacements in m; `None` at rest, for nearest points only.
    pub(crate) u: Option<&'a [Vec3]>,
    pub(crate) index: &'a SurfaceIndex,
}

/// A point of the surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Foot {
    pub(crate) triangle: u32,
    pub(crate) at: Vec3,
    /// Out of the tissue, interpolated between the nodes.
    pub(crate) normal: Vec3,
}

impl Surface<'_> {
    pub(crate) fn corners(&self, triangle: u32) -> [Vec3; 3] {
        let nodes = self.topology.triangle(triangle);
        match self.u {
            Some(u) => nodes.map(|n| self.topology.rest(n) + u[n as usize]),
            None => nodes.map(|n| self.topology.rest(n)),
        }
    }

    /// Triangles whose boxes intersect the ball, in the order of their numbers.
    pub(crate) fn near(&self, centre: Vec3, reach: f64) -> Vec<u32> {
        let ball = Ball {
            centre,
            radius: reach,
        };
        self.index.near(&ball, |t| self.corners(t))
    }

    /// Whether any triangle whose box intersects the ball passes a test.
    pub(crate) fn any_near(&self, centre: Vec3, reach: f64, test: impl FnMut(u32) -> bool) -> bool {
        let ball = Ball {
            centre,
            radius: reach,
        };
        self.index.any_near(&ball, |t| self.corners(t), test)
    }

    /// The point of the surface nearest to `centre`, if one is within `reach`. Ties (a shared edge) go to
    /// the triangle with the lowest number.
    pub(crate) fn nearest(&self, centre: Vec3, reach: f64) -> Option<Foot> {
        let ball = Ball {
            centre,
            radius: reach,
        };
        let square = |triangle| {
            let corners = self.corners(triangle);
            let w = nearest_weights(&corners, &centre);
            (blend(&corners, &w) - centre).norm_squared()
        };
        let (triangle, _) = match self.u {
            Some(_) => self.index.nearest(&ball, square)?,
            None => self.index.nearest_within(&ball, 0.0, square)?,
        };
        let corners = self.corners(triangle);
        let weights = nearest_weights(&corners, &centre);
        let at = blend(&corners, &weights);
        let nodes = self.topology.triangle(triangle);
        let normals = nodes.map(|node| {
            let around = self.index.around(node).iter();
            let sum: Vec3 = around.map(|&t| area_normal(&self.corners(t))).sum();
            sum.try_normalize(1e-30).unwrap_or_else(Vec3::zeros)
        });
        let normal = blend(&normals, &weights)
            .try_normalize(1e-3)
            .or_else(|| area_normal(&corners).try_normalize(1e-30))?;
        Some(Foot {
            triangle,
            at,
            normal,
        })
    }
}

/// Normal of a triangle with twice its area as length.
pub(crate) fn area_normal(corners: &[Vec3; 3]) -> Vec3 {
    (corners[1] - corners[0]).cross(&(corners[2] - corners[0]))
}

pub(crate) fn blend(corners: &[Vec3; 3], w: &[f64; 3]) -> Vec3 {
    corners[0] * w[0] + corners[1] * w[1] + corners[2] * w[2]
}

/// Barycentric weights of the point of a triangle nearest to `p`.
pub(crate) fn nearest_weights(corners: &[Vec3; 3], p: &Vec3) -> [f64; 3] {
    let mut weights = [0.0; 3];
    match nearest_feature(p, corners) {
        Feature::Corner(i) => weights[i] = 1.0,
        Feature::Edge(i, j, part) => {
            weights[i] = 1.0 - part;
            weights[j] = part;
        }
        Feature::Face(parts) => {
            let sum: f64 = parts[0] + parts[1] + parts[2];
            if sum <= 0.0 || !sum.is_finite() {
                return [1.0, 0.0, 0.0];
            }
            weights = parts.map(|v| v / sum);
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_point_is_the_minimum_over_the_triangle() {
        let corners = [
            Vec3::new(0.0, 0.0, 0.0),
            Vec3::new(2.0, 0.0, 0.5),
            Vec3::new(0.3, 1.5, 0.0),
        ];
        for i in 0..125 {
            let p = Vec3::new(
                f64::from(i % 5) - 1.5,
                f64::from(i / 5 % 5) - 1.5,
                f64::from(i / 25) - 2.0,
            );
            let w = nearest_weights(&corners, &p);
            assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            let d = (blend(&corners, &w) - p).norm();
            for a in 0..=10 {
                for b in 0..=10 - a {
                    let v = [f64::from(a) / 10.0, f64::from(b) / 10.0];
                    let other = blend(&corners, &[v[0], v[1], 1.0 - v[0] - v[1]]);
                    assert!(d <= (other - p).norm() + 1e-12, "{p} {w:?}");
                }
            }
        }
    }
}
