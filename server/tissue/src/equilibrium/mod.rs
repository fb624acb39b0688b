//! The quasi-static equilibrium of the length law (Lin 2007, section 3.4) under tools.
//!
//! A step is a list of stages: gather contacts, sweep what is active, then per iteration measure the
//! forces left, correct on the coarse levels, sweep twice. The sweeps are nonlinear Gauss-Seidel with
//! the tangent block of each node (`field`, `law`); the coarse levels are Galerkin operators of the
//! length law at rest over halved lattices (`hierarchy`, `cycle`), to which contacts and held nodes
//! add their stiffness while they last. Everything works on lists of what is active, so a step costs
//! what it moves; only the correction of the coarse levels, where it is worth more than a tenth of a
//! node's threshold, reaches farther. One thread, no clock, a fixed order: the same steps give the
//! same bits.
//!
//! The term of volume has its place in `law` (force and tangent of a node over its cells) and in the
//! rows of `hierarchy`; springs stand alone so far.
//!
//! # Measured
//!
//! A built thigh of 70,000 nodes at 4 mm (skin surface, muscle, pinned femur), sphere of 8 mm pressed at
//! 100 mm/s into fat of 3 kPa from two sides, a step every 4 ms. With what a hand's millisecond allows
//! (four iterations at most, tolerance 3e-2) the force is 0 to 11 % above the converged one down to
//! 11 mm, 16 % at 12 mm; it trails the press and closes up within a few steps when the hand rests.
//! From one step to the next 1e-4 takes 17 to 55 iterations. `examples/press.rs` measures a block.
//!
//! # What it can not do
//!
//! Springs alone keep Poisson's ratio at a quarter and buckle under a deep press; the guard of `law`
//! keeps them from folding, where a term of volume would keep them from buckling. A point tool
//! (radius below half a spacing) feels the corners of the mesh: up to 0.4 of the force within 0.05 mm
//! as it slides from triangle to triangle in its own dent; and a sphere thinner than the spacing can
//! slip between the samples of a soft surface when it is pressed deeper than its own radius.

mod block;
mod brick;
mod coarsen;
mod cycle;
mod element;
mod field;
mod foresight;
mod jacobi;
mod kernel;
mod lanes;
mod law;
mod patch;
mod solver;
mod structure;

pub(crate) use law::Elastic;
pub use solver::{Budget, Solver, StepReport};
