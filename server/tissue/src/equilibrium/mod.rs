//! The quasi-static equilibrium of the length law (Lin 2007, section 3.4) under tools.
//!
//! | noun | what it is |
//! | --- | --- |
//! | `law`, `fibres` | what a material makes of springs: length law, volume term, guard, extreme springs, fibres |
//! | `hold`, `corners` | what keeps tissue that bottoms out from folding: held springs, hardening corners |
//! | `brick`, `kernel`, `slight`, `lanes` | forces of eight cells at a time, in vectors |
//! | `coarsen`, `element`, `matrix`, `structure` | coarse lattices that open where cuts do, with a matrix per element |
//! | `prolongation` | trilinear interpolation between two levels |
//! | `patch`, `cycle`, `beyond` | the part of the coarse lattices near the tools, one V-cycle over it, what it does beyond |
//! | `overlay`, `stiffen` | what tools and hardened tissue add to the coarse lattices |
//! | `field`, `choice`, `moves`, `blocks`, `near` | forces on nodes, which of them take part, smoothing |
//! | `budget`, `relief` | what a step may cost, what it did, and what may wait for it |
//! | `home`, `weight` | where tissue is that nothing touches; what gravity does to it |
//! | `foresight`, `path`, `bind` | the last step's change carried on, along a curve; what hinders a move |
//! | `prescribed` | nodes with a prescribed displacement |
//! | `follower` | a cut's consequences, worked out beside the solvers |
//! | `solver` | one step: its stages, its books |
//! | `jacobi` | the seed's iteration (3.10), the named baseline |
//!
//! A step is a list of stages: carry the last change on, gather contacts, then per iteration choose
//! what takes part, compute its forces, correct by the coarse levels, smooth. Coarse operators are those
//! of the rest state, but where tissue has hardened; how much of their correction is taken is measured afterwards. One order of
//! everything, no clock: the same steps give the same bits, on any number of threads and with vectors of
//! any width.
//!
//! # Measured
//!
//! `palpate-lab bench press-cube` and `press-scene`, one thread of a shared machine: a cube of 8,000
//! nodes from rest to 1 % in 6.5 ms, of 64,000 in 44 ms; a disc that moves on in 0.6 ms per step that needs no
//! iteration, in 3.3 ms with one. A real thigh of 70,000 nodes pressed at 100 mm/s in 1.25 ms per tick (99 %
//! below 1.6 ms): force error 1.4 % rms, 3.1 % at most; drawn back in 1.3 ms (1.7 ms), 6 % rms. One of 528,000 nodes
//! in 1.8 ms (2.2 to 2.5 ms), 7.5 % rms.
//!
//! # What it can not do
//!
//! Coarse operators follow tissue that hardens and do not turn with it. Springs that are not to bottom out fold from
//! 30 % of a layer's thickness on. A stiff layer over something ten times softer is too stiff in a hand's steps. Near incompressible materials (Poisson's ratio 0.45)
//! smooth slowly. A point tool (radius below half a spacing) feels the corners of the mesh, and slips between the
//! samples of a soft surface when it is pressed deeper than its own radius.

// Vectors exist only where everything is inlined into what was dispatched.
#![allow(clippy::inline_always)]

mod beyond;
mod bind;
mod block;
mod blocks;
mod brick;
mod budget;
mod choice;
mod coarsen;
mod corners;
mod cycle;
#[cfg(test)]
mod deferred_tests;
mod element;
mod fibres;
mod field;
mod follower;
mod foresight;
mod hold;
mod home;
mod jacobi;
mod kernel;
mod lanes;
mod law;
mod matrix;
mod moves;
mod near;
mod overlay;
mod patch;
mod path;
mod prescribed;
mod prolongation;
mod relief;
mod slight;
mod solver;
mod state;
mod stiffen;
mod structure;
mod weight;

pub use budget::{Budget, StepReport};
pub(crate) use fibres::dyad;
pub use follower::{Follower, Successor};
pub use home::Sag;
pub(crate) use law::Elastic;
pub use solver::Solver;
pub use state::SolverState;
pub(crate) use weight::adrift;
