//! From voxel indices to the world.

use std::path::Path;

use nalgebra::Matrix3;

use palpate_tissue::Vec3;

use super::volume::bad_orientation;
use crate::InputError;

/// Volume that the three steps span, relative to the product of their lengths, below which they lie
/// in one plane. Reason: 1e-3 is a shear of 89.9 degrees, more than any scanner's table tilts.
const FLAT: f64 = 1e-3;

/// world = `linear` · (i, j, k) + `origin`, for the middle of voxel (i, j, k), in m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    /// Columns are the steps from one voxel to the next along i, j and k, in m. They need not be at
    /// right angles.
    pub linear: Matrix3<f64>,
    /// Middle of voxel (0, 0, 0) in m.
    pub origin: Vec3,
}

impl Affine {
    /// The world position of a point given in voxel indices (the middle of a voxel has integer indices).
    pub fn world(&self, index: &Vec3) -> Vec3 {
        // Written out: the sum has one order on every machine.
        let m = &self.linear;
        Vec3::from_fn(|r, _| {
            m[(r, 0)] * index.x + m[(r, 1)] * index.y + m[(r, 2)] * index.z + self.origin[r]
        })
    }

    /// Lengths of the three steps in m.
    pub fn spacing_m(&self) -> [f64; 3] {
        [0, 1, 2].map(|a| self.linear.column(a).norm())
    }

    /// Volume in m³ of one voxel, negative when the indices are left-handed in the world.
    pub fn determinant(&self) -> f64 {
        let [a, b, c] = [0, 1, 2].map(|i| Vec3::from(self.linear.column(i)));
        a.dot(&b.cross(&c))
    }

    /// The same, if it is usable; `from` names its origin in the file `path`.
    pub(super) fn checked(self, path: &Path, from: &str) -> Result<Self, InputError> {
        match self.fault() {
            Some(what) => Err(bad_orientation(path, from, what)),
            None => Ok(self),
        }
    }

    /// The defect that makes it unusable, if any.
    fn fault(&self) -> Option<String> {
        let all = self.linear.iter().chain(self.origin.iter());
        if !all.into_iter().all(|x| x.is_finite()) {
            return Some("it holds a number that is infinite or not a number".into());
        }
        let spacing = self.spacing_m();
        if let Some(a) = spacing.iter().position(|s| *s == 0.0) {
            let axis = ["first", "second", "third"][a];
            return Some(format!("the step along the {axis} axis is zero"));
        }
        let filled = self.determinant().abs() / spacing.iter().product::<f64>();
        (filled < FLAT).then(|| "its three axes lie in one plane (it is singular)".into())
    }
}
