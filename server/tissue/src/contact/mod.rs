//! Spherical tools against the outer surface of the tissue, without friction.
//!
//! A tool of radius R at c presses with a stiff foundation: a sample x of the surface that lies
//! within the sphere is pushed out along n = (x - c)/|x - c| by
//!
//! ```text
//! f = κ max(0, R - |x - c|) n          x = Σ w_k x_k over the nodes of its triangle
//! ```
//!
//! shared by the three nodes as `w_k f`; the tool feels the opposite. Each triangle has four samples
//! of equal area, half a spacing apart, or one where the lattice is fine beside the tool ([`FINE_RADIUS`]): a
//! lattice half as fine has as many under it. κ is [`FOUNDATION`] times the stiffness that the nodes
//! under the sample have themselves, which leaves a penetration of one or two parts in a hundred
//! of the indentation. Nothing can pull, and the force grows from zero as a sample enters: so it is
//! continuous while the tool moves. A triangle that faces away from the centre (the far skin of a
//! thin flap) fades out over a range of angles.
//!
//! Below [`POINT_RADIUS`] of the spacing a sphere would slip between samples. Such a tool has one
//! sample: the point of the surface nearest to it, with barycentric `w_k` and the interpolated
//! normal.
//!
//! What is pressed into the tissue is not the tool but its proxy, which remembers on which side of
//! the surface it is: it stops where it first touches, and moves by half a radius per iteration at
//! most while it touches. A tool that jumps, or first shows up deep inside, is followed from
//! outside.

mod along;
mod ball;
mod contacts;
mod fans;
mod index;
mod proxy;
mod reaction;
mod sample;
mod surface;
#[cfg(test)]
mod tests;
mod watched;

pub use reaction::Reaction;

pub(crate) use contacts::Contacts;
pub(crate) use index::SurfaceIndex;

use crate::Vec3;

/// Stiffness of the foundation between tool and tissue, in parts of the nodes' own.
pub(crate) const FOUNDATION: f64 = 20.0;
/// Radius, in spacings, below which a tool is a point.
pub(crate) const POINT_RADIUS: f64 = 0.5;
/// Radius, in spacings, from which on every triangle has one sample. Under a sphere of 8 mm on a lattice of 2 mm four
/// make a converged force 0.3 to 0.9 % lower, and take a seventh of a tick.
pub(crate) const FINE_RADIUS: f64 = 3.0;
/// Tools that are looked at in one step; more than these are ignored and counted. More than any
/// table has hands around it.
pub const TOOLS_MAX: usize = 64;

/// A spherical tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tool {
    /// Tells tools apart from step to step; two tools of one step have different ones.
    pub id: u32,
    /// Centre in m.
    pub centre: Vec3,
    /// Radius in m, above zero.
    pub radius_m: f64,
}

impl Tool {
    /// Whether pose and radius are numbers that mean something.
    pub fn is_sound(&self) -> bool {
        self.radius_m > 0.0
            && self.radius_m.is_finite()
            && self.centre.iter().all(|v| v.abs() < 1e6)
    }
}
