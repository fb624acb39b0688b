//! Rounded tools against the outer surface of the tissue, without friction.
//!
//! A tool is the set of points within its radius R of a core: a point (a ball), a line (a needle, an edge) or a
//! rectangle (a plate, a jaw). Contact is an augmented Lagrangian (`multipliers`): a sample x of the surface is pushed
//! out from its nearest core point c along n = (x - c)/|x - c| by
//!
//! ```text
//! f = max(0, λ + κ (R - |x - c|)) n          x = Σ w_k x_k over the nodes of its triangle
//! ```
//!
//! The three nodes share it as `w_k f`; the tool receives the opposite force. Each triangle has four samples of equal
//! area, half a spacing apart, or one where the lattice is fine compared to the tool ([`FINE_RADIUS`]), and more where it
//! is stretched. The contact penalty stiffness κ is [`PENALTY`] times the stiffness of the nodes under the sample;
//! converged forces do not depend on it, except on fixed nodes. Contacts never pull, and the force grows from zero at
//! touch, so it is continuous. A triangle that faces away from the core (the far skin of a thin flap) fades out over a
//! range of angles.
//!
//! Below [`POINT_RADIUS`] spacings a tool would slip between samples. Such a tool presses with that radius on a surface
//! that is offset inwards by the difference (`outwards`): it touches at the right place, and its dent is as narrow as
//! the lattice resolves. (Rejected: the core's points against their nearest surface points. The walls of the dent
//! change the nearest point, and forces on retreat were 25 % higher than on approach.)
//!
//! The reaction on a tool is a force, a torque about the pivot, T = Σ (x - pivot) × f (Lin 2007, fig 4.13), and the
//! shares of up to [`PLACES_MAX`] contact patches, each with its own friction.
//!
//! The tissue is pressed by the proxy of a tool, which stays on its side of the surface: it stops at first touch, and
//! in contact moves only as far as the tissue has yielded (`constraint`). A tool that jumps, or appears inside the
//! tissue, is followed from outside.
//!
//! The tip of a needle holds the surface from its first touch on: from then on the tissue is tied to the needle (`channel`),
//! and no sample presses on it until it has left.

mod ball;
mod channel;
mod clearance;
mod constraint;
mod contact_sample;
mod contacts;
mod core;
mod insertion;
mod line_search;
mod multipliers;
mod outwards;
mod proxy;
mod reaction;
mod surface;
mod surface_index;
#[cfg(test)]
mod tests;
mod tie;
mod tool;
mod watched;

pub use clearance::Clearance;
pub use reaction::{ContactPatch, Reaction, ShaftReaction};
pub use tool::{Form, Needle, TOOL_REACH_MAX_M, Tool};

pub(crate) use contacts::Contacts;
pub(crate) use line_search::LineSearch;
pub(crate) use surface_index::{SurfaceChange, SurfaceIndex, SurfaceTree, TreeRoom};

/// Contact penalty stiffness relative to that of the nodes. Quick steps need it, converged forces do not: with 12 a ball
/// 15 mm deep in a thigh loses its contact, with 40 the first touch of stiff skin is 69 instead of 55 % too stiff.
pub(crate) const PENALTY: f64 = 25.0;
/// Largest λ/κ in spacings. Without it, the force of a tool held on tissue pressed flat varies by 16 to 22 % instead of 3; with
/// 0.75 or less a deep press into soft tissue loses its contact.
pub(crate) const MULTIPLIER_MAX: f64 = 1.0;
/// Smallest contact radius in spacings. With half a spacing a ball that retreated from 7 mm slipped between the samples
/// of a lattice of 4 mm.
pub(crate) const POINT_RADIUS: f64 = 0.75;
/// Distance between the sampling points of a thin tool's first-touch test, in spacings (Lin 2007, figs 4.15 and 4.16:
/// half the resolution).
pub(crate) const PITCH: f64 = 0.5;
/// Radius in spacings from which every triangle has one sample. Under a sphere of 8 mm on a lattice of 2 mm four
/// samples change a converged force by -0.3 to -0.9 % and cost a seventh of a tick.
pub(crate) const FINE_RADIUS: f64 = 3.0;
/// Maximum tools per step; excess tools are ignored and counted. A session has at most 64 participants, and forceps are
/// two tools.
pub const TOOLS_MAX: usize = 128;
/// Maximum contact patches of a tool: forces along a line or on a surface are summed per patch.
pub const PLACES_MAX: usize = 16;
