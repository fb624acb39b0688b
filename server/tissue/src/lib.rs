//! The deformable model: its equilibrium under tools, cutting, model files, snapshots and hashes.
//!
//! This crate never opens a socket, never reads a clock and reads only model files. Three kinds of data are kept
//! apart: what was built, what cuts and tools change, and the scratch memory of the solvers. A [`Tissue`] owns the last two.
//!
//! ```text
//!  model file --decode_model--> Model   immutable: nodes, cells, regions with their Material
//!                                 |
//!             CutStroke --cut--> Tissue ----> CutOutcome
//!          Tool, Budget --step-->   |   ----> StepReport with one Reaction per tool
//!                                   |
//!                                   +-- Topology   wiring and rest positions; cuts change it
//!                                   +-- Shape      displacement of each node; tools change it
//!                                   +-- scratch memory of the solver
//!
//!  another thread: CutPreparer --prepare--> PreparedCut --succeed--> Tissue
//! ```
//!
//! Press a block of tissue, then cut it:
//!
//! ```
//! use palpate_tissue::*;
//!
//! let model = block([10, 10, 6], 0.004, &Material::default(), 1);
//! let mut tissue = Tissue::new(model.into());
//! let tool = Tool::ball(1, Vec3::new(0.02, 0.02, 0.03), 0.008);
//! let report = tissue.step(&[tool], Budget::new(100, 1e-3));
//! assert!(report.reactions[0].force.z > 0.0);
//!
//! let point = |y| BladePoint { tip: Vec3::new(0.0201, y, 0.012), axis: Vec3::z(), depth_m: 0.02 };
//! let stroke = CutStroke { points: vec![point(0.01), point(0.03)], width_m: 0.0 };
//! tissue.cut(&stroke)?;
//! assert_eq!(tissue.topology().version(), 1);
//! # Ok::<(), CutError>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod blades;
mod block;
pub mod cell;
mod contact;
mod cut;
mod cut_history;
mod cut_model;
mod equilibrium;
mod fibre;
pub mod file;
mod fit;
pub mod material;
mod model;
pub mod nearest;
mod number_map;
mod pages;
mod rows;
mod shape;
pub mod snapshot;
pub mod springs;
mod stroke_list;
mod tissue;
mod topology;

pub use blades::Blades;
pub use block::block;
pub use cell::Cell;
pub use contact::{Clearance, ContactPatch, Form, Needle, Reaction, ShaftReaction, Tool};
pub use cut::{
    BladePoint, CutError, CutOutcome, CutStroke, EdgeResistance, EdgeTrack, Moved, RestPoint,
    StrokePart, SweptSurface, cut, edge_resistance, to_rest,
};
pub use cut_history::CutHistory;
pub use equilibrium::{
    Budget, CutPreparer, Mechanism, PreparedCut, Retired, Sag, StepReport, Tension, TopologyCut,
};
pub use material::{FibreAxis, Material};
pub use model::{Model, Region, RegionId};
pub use rows::Rows;
pub use shape::Shape;
pub use tissue::Tissue;
pub use topology::{Boundary, FaceId, Topology, TopologyHash};

/// A vector or point of the model, in metres, newtons or the unit of its name.
pub type Vec3 = nalgebra::Vector3<f64>;

/// Bounds beyond which input is rejected.
pub mod limits {
    pub use crate::contact::{PLACES_MAX, TOOL_REACH_MAX_M, TOOLS_MAX};
    pub use crate::cut::{
        BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX, REST_WIDTH_MAX, STROKE_LENGTH_MAX_M, WOUND_WIDTH_MAX_M,
    };
    pub use crate::file::{CELLS_MAX, NODES_MAX, POSITION_MAX_M, REGIONS_MAX};
}
