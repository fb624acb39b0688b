//! Closed triangle surfaces: reading, checking, repairing and writing them.
//!
//! A surface is the boundary of one region. [`Surface::read`] converts STL, OBJ and PLY files to metres with
//! welded vertices. [`Surface::check`] rejects surfaces that enclose no volume and makes all repairs that need
//! no guessing.

mod check;
mod check_report;
mod crossings;
mod edges;
mod obj;
mod orient;
mod ply;
mod read;
mod separation;
mod stl;
mod weld;

pub use check_report::CheckReport;
pub use crossings::crossings;
pub(crate) use edges::{Edges, Sets, in_mm};
pub use read::{FILE_BYTES_MAX, TRIANGLES_MAX};
pub(crate) use separation::separations;

use edges::EdgeUse;
use palpate_tissue::Vec3;

/// The unit of a surface file. In memory, every length is in metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Unit {
    /// Millimetres: the unit of segmentation and printing tools, and the default.
    #[default]
    Millimetre,
    /// `unit = "m"` in a scene.
    Metre,
}

impl Unit {
    /// Metres in one unit.
    pub const fn metres(self) -> f64 {
        match self {
            Self::Millimetre => 1e-3,
            Self::Metre => 1.0,
        }
    }
}

/// A box along the axes, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aabb {
    /// Smallest coordinate on each axis.
    pub min: Vec3,
    /// Largest coordinate on each axis.
    pub max: Vec3,
}

impl Aabb {
    /// The smallest box that holds all `points`; `None` when there are none.
    pub fn around<'a>(points: impl IntoIterator<Item = &'a Vec3>) -> Option<Self> {
        let mut points = points.into_iter();
        let first = *points.next()?;
        Some(points.fold(
            Self {
                min: first,
                max: first,
            },
            |b, p| Self {
                min: b.min.inf(p),
                max: b.max.sup(p),
            },
        ))
    }

    /// Edge lengths in m.
    pub fn extent(&self) -> Vec3 {
        self.max - self.min
    }

    /// Its centre.
    pub fn centre(&self) -> Vec3 {
        (self.min + self.max) * 0.5
    }

    /// Whether it contains the point, boundary included.
    pub fn contains(&self, p: &Vec3) -> bool {
        (0..3).all(|k| self.min[k] <= p[k] && p[k] <= self.max[k])
    }

    /// Whether the boxes have a point in common, boundaries included.
    fn meets(&self, other: &Self) -> bool {
        (0..3).all(|k| self.min[k] <= other.max[k] && other.min[k] <= self.max[k])
    }
}

/// A triangle surface with welded vertices.
///
/// After [`Surface::check`] has accepted it, it is closed: each edge is used equally often in
/// both directions, and triangles run counter-clockwise seen from outside, so the winding number
/// is 1 inside and 0 outside (a cavity is a component that faces the other way).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Surface {
    /// Positions in m; no two are equal when the surface was read from a file.
    pub vertices: Vec<Vec3>,
    /// Corners of each triangle, indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Positions of a triangle's corners.
    pub fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|v| self.vertices[v as usize])
    }

    /// The middle of a triangle.
    fn middle(&self, triangle: usize) -> Vec3 {
        let [a, b, c] = self.corners(triangle);
        (a + b + c) / 3.0
    }

    /// The middle of an edge, given its uses.
    fn edge_middle(&self, uses: &[EdgeUse]) -> Vec3 {
        let [a, b] = [uses[0].low, uses[0].high].map(|v| self.vertices[v as usize]);
        (a + b) / 2.0
    }

    /// Enclosed volume in m³, negative when the surface is turned inside out (divergence
    /// theorem). Meaningful for a closed surface only.
    pub fn volume(&self) -> f64 {
        signed_volume(self, 0..self.triangles.len())
    }

    /// Area in m².
    pub fn area(&self) -> f64 {
        (0..self.triangles.len())
            .map(|t| {
                let [a, b, c] = self.corners(t);
                (b - a).cross(&(c - a)).norm() * 0.5
            })
            .sum()
    }

    /// The box around all vertices; `None` for an empty surface.
    pub fn aabb(&self) -> Option<Aabb> {
        Aabb::around(&self.vertices)
    }
}

/// Signed volume in m³ below some of the triangles, summed about their first corner so that a
/// small part far from the origin keeps its digits.
fn signed_volume(surface: &Surface, triangles: impl IntoIterator<Item = usize>) -> f64 {
    let mut origin = None;
    triangles
        .into_iter()
        .map(|t| {
            let corners = surface.corners(t);
            let o = *origin.get_or_insert(corners[0]);
            let [a, b, c] = corners.map(|p| p - o);
            a.dot(&b.cross(&c)) / 6.0
        })
        .sum()
}
