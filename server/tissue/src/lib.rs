//! The deformable model: building it from surfaces or label volumes, its equilibrium under tools, cutting,
//! snapshots and hashes.
//!
//! This crate never opens a socket, never reads a clock and reads only files of surfaces, label volumes, scenes
//! and models. Three kinds of data are kept apart: the [`Model`] (immutable, the content of a model file), the
//! [`Topology`] (changed by cuts) with one [`Shape`] per view of it (changed by tools), and the scratch memory
//! of the solvers.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod block;
mod build;
mod cell;
mod contact;
mod cut;
mod equilibrium;
pub mod export;
mod fibre;
mod file;
mod fit;
pub mod labels;
mod material;
mod model;
pub mod sample;
pub mod scene;
mod shape;
mod snapshot;
mod springs;
mod staged;
pub mod surface;
mod topology;

pub use block::block;
pub use build::{
    BUILD_NODES_MAX, BarReport, BuildError, BuildReport, CORNER_FLOOR, DISTANCE_REACH,
    GRID_CELLS_MAX, Layer, LayerReport, Layers, NEIGHBOURS_MAX, Progress, QualityReport,
    RegionReport, SPRING_FLOOR, SpacingReport, SpringCounts, SurfaceReport, THIN_PARTS_MAX,
    ThinKind, ThinPart, ThinParts, build, region_surface, report_surface,
};
pub use cell::{Cell, DIAGONALS, EDGES, FACES, NO_CELL, cell_volume, scaled_jacobian};
pub use contact::{
    Clearance, Form, PLACES_MAX, Place, Reaction, TOOL_REACH_MAX_M, TOOLS_MAX, Tool,
};
pub use cut::{
    BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX, BladePoint, CutError, CutOutcome, CutStroke, Moved,
    RestPoint, STROKE_LENGTH_MAX_M, WOUND_WIDTH_MAX_M, cut, to_rest,
};
pub use equilibrium::{
    Budget, Follower, Mechanism, Sag, Solver, SolverState, StepReport, Successor,
};
pub use file::{
    CELLS_MAX, EnvelopeError, FileError, MODEL_FORMAT, ModelFile, NODES_MAX, REGIONS_MAX,
    decode_model, encode_model,
};
pub use labels::{LabelError, LabelVolume};
pub use material::{FibreAxis, MATERIAL_NAMES, Material, MaterialError, MaterialOverride};
pub use model::{Model, Region, RegionId};
pub use scene::{RegionSource, Scene, SceneError, SceneInput, SceneRegion};
pub use shape::Shape;
pub use snapshot::{SNAPSHOT_FORMAT, SnapshotError, model_hash, restore, snapshot};
pub use springs::{SPRINGS_PER_NODE_MAX, Spring, Springs};
pub use staged::{Staged, WriteError, write_file};
pub use surface::{Aabb, CheckReport, Surface, SurfaceError, Unit};
pub use topology::{Boundary, FaceId, Topology, TopologyHash};

/// A vector or point of the model, in metres, newtons or the unit of its name.
pub type Vec3 = nalgebra::Vector3<f64>;
