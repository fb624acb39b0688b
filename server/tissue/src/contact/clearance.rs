//! The distance between a tool that touches nothing and the surface at rest.

use super::core::Core;
use super::surface::Surface;
use super::{PITCH, SurfaceIndex, Tool};
use crate::{Topology, Vec3};

/// Maximum search distance in m; scenes are smaller.
const REACH_M: f64 = 1e3;

/// Measures distances to the outer surface at rest.
pub struct Clearance<'a> {
    topology: &'a Topology,
    index: SurfaceIndex,
}

impl<'a> Clearance<'a> {
    /// Indexes the surface once for many tools.
    pub fn new(topology: &'a Topology) -> Self {
        Self {
            topology,
            index: SurfaceIndex::new(topology),
        }
    }

    /// The distance in m between `tool` and the surface: positive outside the tissue, negative inside, zero at touch.
    /// `None` for an invalid tool.
    pub fn of(&self, tool: &Tool) -> Option<f64> {
        if !tool.is_sound() {
            return None;
        }
        let core = Core::of(tool);
        let pitch = PITCH * self.topology.model().spacing_m;
        let points = core.points(pitch).into_iter().map(|at| core.at(at));
        let distances = points.filter_map(|point| self.of_point(&point, tool.radius_m));
        distances.min_by(|a, b| a.abs().total_cmp(&b.abs()))
    }

    fn of_point(&self, point: &Vec3, radius: f64) -> Option<f64> {
        let surface = Surface {
            topology: self.topology,
            u: None,
            index: &self.index,
        };
        let foot = surface.nearest(*point, REACH_M)?;
        let away = point - foot.at;
        let gap = (away.norm() - radius).max(0.0);
        Some(gap.copysign(away.dot(&foot.normal)))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{Material, block};

    #[test]
    fn clearance_is_positive_outside_negative_inside_and_zero_at_touch() {
        let model = block([10, 10, 10], 4e-3, &Material::default(), 1);
        let topology = Topology::new(Arc::new(model));
        let clearance = Clearance::new(&topology);
        let at = |z_mm: f64| {
            let ball = Tool::ball(1, Vec3::new(20e-3, 20e-3, z_mm * 1e-3), 5e-3);
            clearance.of(&ball).unwrap() * 1e3
        };
        assert!((at(60.0) - 15.0).abs() < 1e-6, "{}", at(60.0));
        assert!((at(22.0) + 13.0).abs() < 1e-6, "{}", at(22.0));
        assert_eq!(at(43.0).abs(), 0.0);
        assert!(clearance.of(&Tool::ball(1, Vec3::zeros(), 0.0)).is_none());
    }
}
