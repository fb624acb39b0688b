//! From anatomy to a [`Model`](palpate_tissue::Model): scenes of surfaces or label volumes, built-in samples,
//! mesh generation, and export of models for other programs.
//!
//! This crate never opens a socket, never reads a clock and reads only files of surfaces, label volumes and scenes.
//!
//! ```text
//!  scene file           --> Scene ------------+
//!  STL, OBJ, PLY        --> Surface ----------+--> SceneInput --build--> Model, BuildReport
//!  NIfTI, NRRD, DICOM   --> LabelVolume ------+
//!  name of a sample     --> sample::Sample ---+
//!
//!  Topology, Shape      --export--> VTU of cells, STL of surfaces
//! ```
//!
//! Build a sample and write its model file:
//!
//! ```no_run
//! use palpate_anatomy::{build, sample::Sample};
//! use palpate_tissue::file::{encode_model, write_file};
//!
//! let input = Sample::Handle.input()?;
//! let (model, report) = build(&input, &mut |_, _| {})?;
//! println!("{} nodes, {} warnings", report.nodes, report.warnings.len());
//! write_file("handle.palp".as_ref(), encode_model(&model))?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod build;
mod error;
pub mod export;
pub mod labels;
pub mod sample;
pub mod scene;
pub mod surface;

pub use build::{
    BUILD_NODES_MAX, BarReport, BuildReport, COMPONENTS_MAX, CORNER_FLOOR, CRUMB_MM3,
    ComponentLoss, ComponentReport, ContactReport, FaultKind, GRID_CELLS_MAX, GapReport, KEPT_MIN,
    Layer, LayerReport, Layers, LostCrumbs, MergedComponent, NEIGHBOURS_MAX, Progress,
    QualityReport, RegionReport, SPRING_FLOOR, SpacingReport, SpringCounts, SurfaceFault,
    SurfaceReport, THIN_PARTS_MAX, ThinKind, ThinPart, ThinParts, build, region_surface,
};
pub use error::InputError;
pub use labels::LabelVolume;
pub use scene::{RegionSource, Scene, SceneInput, SceneRegion, Thresholds};
pub use surface::{Aabb, CheckReport, Surface, Unit};
