//! `palpate-server sample`: generated anatomy and products to begin with.

use std::path::{Path, PathBuf};

use palpate_tissue::sample::Sample;

use crate::ServerError;

/// Writes the scene and the surfaces of a sample; gives the scene file.
pub(crate) fn write(name: &str, dir: &Path, force: bool) -> Result<PathBuf, ServerError> {
    let sample: Sample = name.parse()?;
    Ok(sample.generate().write(dir, force)?)
}
