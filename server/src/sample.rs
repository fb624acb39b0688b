//! `palpate-server sample`: generated example models of anatomy and products.

use std::path::{Path, PathBuf};

use palpate_anatomy::sample::Sample;

use crate::ServerError;

/// Writes the scene and the surfaces of a sample. Returns the scene file.
pub(crate) fn write(name: &str, dir: &Path, force: bool) -> Result<PathBuf, ServerError> {
    let sample: Sample = name.parse()?;
    Ok(sample.generate().write(dir, force)?)
}
