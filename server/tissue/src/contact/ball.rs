//! Balls as search regions.

use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::Vector;

use crate::Vec3;

/// A ball in space, in m.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ball {
    pub(crate) centre: Vec3,
    pub(crate) radius: f64,
}

impl Ball {
    pub(crate) fn wider(&self, by: f64) -> Self {
        Self {
            centre: self.centre,
            radius: self.radius + by,
        }
    }

    /// Whether all of the other ball is in this one.
    pub(crate) fn holds(&self, other: &Self) -> bool {
        (other.centre - self.centre).norm() + other.radius <= self.radius
    }

    /// Whether the ball intersects a box.
    #[inline]
    pub(crate) fn reaches(&self, mins: Vector, maxs: Vector) -> bool {
        self.away(mins, maxs) <= self.radius * self.radius
    }

    #[inline]
    pub(crate) fn reaches_box(&self, b: &Aabb) -> bool {
        self.reaches(b.mins, b.maxs)
    }

    /// Square of the distance from its centre to a box.
    #[inline]
    pub(crate) fn away(&self, mins: Vector, maxs: Vector) -> f64 {
        let p = Vector::new(self.centre.x, self.centre.y, self.centre.z);
        (mins - p).max(p - maxs).max(Vector::ZERO).length_squared()
    }
}
