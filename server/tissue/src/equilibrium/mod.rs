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
//! # Measured (`examples/press.rs`)
//!
//! Block of 62,928 nodes at 4 mm, E = 10 kPa, sphere of 8 mm pressed at 100 mm/s, a step every 4 ms.
//! Down to 5 mm, one iteration per step at a tolerance of 1e-2 keeps the force within 2.2 % of the
//! converged one and looks at 11,500 nodes per step in the mean, a fifth of the model; two iterations
//! keep it within about 1 %. A cold solve to 1e-5 after a step of 2 mm takes 17 to 33 iterations.
//! Cube of 20 nodes per edge, disc of 12.5 mm held 1 mm down, cold: the error shrinks to 0.55 of
//! itself per iteration, 1 % rms after eight.
//!
//! # What it can not do
//!
//! Between 5 and 6 mm that press folds the bare lattice under the sphere: the converged force drops
//! by a third, and two paths to the same depth may rest in different folds (up to 80 % apart while
//! the fold is under way, within 7 % again below 12 mm). That is a property of springs without a
//! term of volume, not of the solver. A point tool (radius below half a spacing) feels the corners of
//! the mesh: up to 0.4 of the force within 0.05 mm as it slides from triangle to triangle in its own
//! dent.

pub(crate) mod block;
mod cycle;
mod field;
mod hierarchy;
mod jacobi;
mod lattice;
pub(crate) mod law;
mod solver;

pub use solver::{Budget, Solver, StepReport};
