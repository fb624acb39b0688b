//! A model in its current state as files for other programs: a VTK unstructured grid of its cells,
//! and its surfaces as STL. Lengths in these files are in mm.
//!
//! Both writers are our own. Writing one kind of VTK file with arrays of numbers takes a page of code over the
//! deflate library that the crate uses anyway. A VTK library would add an XML parser and a legacy parser that
//! are not needed. `tests/readers/` checks with meshio and trimesh that other programs can read the files.

mod apart;
mod surfaces;
mod vtu;

pub use apart::StlFigures;
pub use surfaces::{NamedSurface, stage_outer_stl, stage_stl, surfaces};
pub use vtu::{stage_vtu, write_vtu};
