//! The deformable model: its equilibrium under tools, cutting, model files, snapshots and hashes.
//!
//! This crate never opens a socket, never reads a clock and reads only model files. Three kinds of data are kept
//! apart: the [`Model`] (immutable, the content of a model file), the [`Topology`] (changed by cuts) with one
//! [`Shape`] per view of it (changed by tools), and the scratch memory of the solvers.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod block;
mod cell;
mod contact;
mod cut;
mod equilibrium;
mod fibre;
mod file;
mod fit;
mod material;
mod model;
mod nearest_name;
mod shape;
mod snapshot;
mod springs;
mod staged;
mod topology;

pub use block::block;
pub use cell::{Cell, DIAGONALS, EDGES, FACES, NO_CELL, cell_volume, scaled_jacobian};
pub use contact::{
    Clearance, Form, PLACES_MAX, Place, Reaction, TOOL_REACH_MAX_M, TOOLS_MAX, Tool,
};
pub use cut::{
    BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX, BladePoint, CutError, CutOutcome, CutStroke, Moved,
    RestPoint, STROKE_LENGTH_MAX_M, WOUND_WIDTH_MAX_M, cut, to_rest,
};
pub use equilibrium::{Budget, Follower, Sag, Solver, SolverState, StepReport, Successor};
pub use file::{
    CELLS_MAX, EnvelopeError, FileError, MODEL_FORMAT, ModelFile, NODES_MAX, POSITION_MAX_M,
    REGIONS_MAX, decode_model, encode_model,
};
pub use material::{FibreAxis, MATERIAL_NAMES, Material, MaterialError, MaterialOverride};
pub use model::{Model, Region, RegionId};
pub use nearest_name::nearest_name;
pub use shape::Shape;
pub use snapshot::{SNAPSHOT_FORMAT, SnapshotError, model_hash, restore, snapshot};
pub use springs::{SPRINGS_PER_NODE_MAX, Spring, Springs};
pub use staged::{Staged, WriteError, write_file};
pub use topology::{Boundary, FaceId, Topology, TopologyHash};

/// A vector or point of the model, in metres, newtons or the unit of its name.
pub type Vec3 = nalgebra::Vector3<f64>;
