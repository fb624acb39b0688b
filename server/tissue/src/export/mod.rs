//! A model in its current state as files for other programs: a VTK unstructured grid of its cells,
//! and its surfaces as STL. Lengths in these files are in mm.
//!
//! Both writers are our own. Of the VTK format we need the writing of one kind of file with arrays of
//! numbers, a page of code over the deflate that is here anyway; the library for it would bring an
//! XML and a legacy parser for reading what we never read. That others read the files is tested with
//! meshio and trimesh (`tests/readers/`).

mod surfaces;
mod vtu;

pub use surfaces::{NamedSurface, stage_stl, surfaces};
pub use vtu::{stage_vtu, write_vtu};
