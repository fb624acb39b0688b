//! The deformable model: building it from surfaces, its equilibrium under tools, cutting,
//! snapshots and hashes.
//!
//! This crate never opens a socket, never reads a clock and knows no file but those of model
//! formats. Three kinds of data are kept apart: the [`Model`] (immutable, what a model file
//! holds), the [`Topology`] (what cuts change) with one [`Shape`] per view of it (what pressing
//! changes), and the scratch memory of the solvers.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod block;
mod cell;
mod material;
mod model;
mod shape;
mod springs;
mod topology;

pub use block::block;
pub use cell::{Cell, DIAGONALS, EDGES, FACES, NO_CELL, cell_volume};
pub use material::Material;
pub use model::{Model, Region, RegionId};
pub use shape::Shape;
pub use springs::{SPRINGS_PER_NODE_MAX, Spring, Springs};
pub use topology::{Boundary, FaceId, Topology, TopologyHash};

/// A vector or point of the model: metres, newtons or whatever the name beside it says.
pub type Vec3 = nalgebra::Vector3<f64>;
