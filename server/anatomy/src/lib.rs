//! From anatomy to a [`Model`](palpate_tissue::Model): scenes of surfaces or label volumes, built-in samples,
//! mesh generation, and export of models for other programs.
//!
//! This crate never opens a socket, never reads a clock and reads only files of surfaces, label volumes and scenes.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod build;
pub mod export;
pub mod labels;
pub mod sample;
pub mod scene;
pub mod surface;

pub use build::{
    BUILD_NODES_MAX, BarReport, BuildError, BuildReport, CORNER_FLOOR, DISTANCE_REACH,
    GRID_CELLS_MAX, Layer, LayerReport, Layers, NEIGHBOURS_MAX, Progress, QualityReport,
    RegionReport, SPRING_FLOOR, SpacingReport, SpringCounts, SurfaceReport, THIN_PARTS_MAX,
    ThinKind, ThinPart, ThinParts, build, region_surface, report_surface,
};
pub use labels::{LabelError, LabelVolume};
pub use scene::{RegionSource, Scene, SceneError, SceneInput, SceneRegion};
pub use surface::{Aabb, CheckReport, Surface, SurfaceError, Unit};
