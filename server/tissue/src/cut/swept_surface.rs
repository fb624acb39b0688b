//! Distances from the surface that a stroke sweeps.

use super::ribbon::Ribbon;
use super::stroke::CutStroke;
use crate::Vec3;

/// The surface that the nodes of a cut are snapped onto: the one that the blade swept, continued beyond its rims by
/// three spacings, because the front of a cut ends between two nodes.
#[derive(Debug)]
pub struct SweptSurface(Ribbon);

impl SweptSurface {
    /// The surface of a valid stroke; `spacing_m` is that of the lattice. On an invalid stroke: its error.
    pub fn of(stroke: &CutStroke, spacing_m: f64) -> Result<Self, String> {
        stroke.check(spacing_m)?;
        Ok(Self(Ribbon::continued(&stroke.points, spacing_m)))
    }

    /// Distance of a point in m; `None` farther away than about three spacings.
    pub fn distance_m(&self, p: &Vec3) -> Option<f64> {
        self.0.nearest(p).map(|foot| (foot.point - p).norm())
    }
}
