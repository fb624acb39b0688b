//! Rounded tools against the outer surface of the tissue, without friction.
//!
//! A tool is all that lies within its radius R of a core: a point (a ball), a line (a needle, an edge) or a
//! rectangle (a plate, a jaw). It presses with a stiff foundation: a sample x of the surface that lies
//! within R of the point c of the core nearest to it is pushed out along n = (x - c)/|x - c| by
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
//! continuous while the tool moves. A triangle that faces away from the core (the far skin of a
//! thin flap) fades out over a range of angles.
//!
//! Below [`POINT_RADIUS`] of the spacing a tool would slip between samples. Such a tool presses with that radius, on
//! a surface that lies deeper by what it is too wide (`outwards`): it touches where it should, and its dent is as
//! narrow as the lattice can show. (Its own points with the nearest points of the surface were tried: the walls of
//! the dent turn what is nearest, forces on the way back were a quarter higher than on the way in, and the last digit of a place
//! decided between the two.)
//!
//! What the tissue does to a tool is told as a force, a torque about the pivot, T = Σ (x - pivot) × f (Lin 2007,
//! fig 4.13), and the shares of up to [`PLACES_MAX`] places of the tool: friction acts at each on its own.
//!
//! What is pressed into the tissue is not the tool but its proxy, which remembers on which side of
//! the surface it is: it stops where it first touches, and moves by half a radius per iteration at
//! most while it touches. A tool that jumps, or first shows up deep inside, is followed from
//! outside.

mod along;
mod ball;
mod clearance;
mod contacts;
mod core;
mod fans;
mod index;
mod outwards;
mod proxy;
mod reaction;
mod sample;
mod surface;
#[cfg(test)]
mod tests;
mod tool;
mod watched;

pub use clearance::Clearance;
pub use reaction::{Place, Reaction};
pub use tool::{Form, TOOL_REACH_MAX_M, Tool};

pub(crate) use contacts::Contacts;
pub(crate) use index::SurfaceIndex;
pub(crate) use proxy::Proxy;

/// Stiffness of the foundation between tool and tissue, in parts of the nodes' own.
pub(crate) const FOUNDATION: f64 = 20.0;
/// Radius, in spacings, that the thinnest tool presses with. With half a spacing a ball that drew back from 7 mm was let
/// through between the samples of a lattice of 4 mm.
pub(crate) const POINT_RADIUS: f64 = 0.75;
/// Distance between the points of a thin tool that look for the first touch, in spacings (Lin 2007, figs 4.15 and 4.16: half the
/// resolution).
pub(crate) const PITCH: f64 = 0.5;
/// Radius, in spacings, from which on every triangle has one sample. Under a sphere of 8 mm on a lattice of 2 mm four
/// make a converged force 0.3 to 0.9 % lower, and take a seventh of a tick.
pub(crate) const FINE_RADIUS: f64 = 3.0;
/// Tools that are looked at in one step; more than these are ignored and counted. A session has 64 people
/// at most, and forceps are two.
pub const TOOLS_MAX: usize = 128;
/// Places of a tool that are told apart at most: what touches it along a line or a surface is summed in so many parts.
pub const PLACES_MAX: usize = 16;
