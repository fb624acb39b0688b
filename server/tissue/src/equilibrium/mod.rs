//! The quasi-static equilibrium of the length law (Lin 2007, section 3.4) under tools.

pub(crate) mod block;
mod cycle;
mod field;
mod hierarchy;
mod jacobi;
mod lattice;
pub(crate) mod law;
mod solver;

pub use solver::{Budget, Solver, StepReport};
