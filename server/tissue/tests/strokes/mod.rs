//! Random strokes on a model, and the laws of the sheets that they open.

// Each test file uses a part of it.
#![allow(clippy::unwrap_used, dead_code)]

pub(crate) mod random_stroke;
pub(crate) mod sheet_figures;
pub(crate) mod sheet_laws;
