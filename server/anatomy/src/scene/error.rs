//! Errors of scenes.

use std::path::PathBuf;

use palpate_tissue::material::MaterialError;
use thiserror::Error;

use super::{SCENE_BYTES_MAX, SCENE_FORMAT};
use crate::labels::LabelError;
use crate::surface::SurfaceError;

/// The reason why a scene was rejected.
#[derive(Debug, Error)]
pub enum SceneError {
    /// The file could not be read.
    #[error("{}: {source}; check the path and that the file is readable", path.display())]
    Io {
        /// The scene file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Too large to be a scene.
    #[error(
        "{}: {bytes} bytes, a scene has at most {SCENE_BYTES_MAX}; is this a \
         surface or a model? A scene is a TOML text that begins with \
         format = \"{SCENE_FORMAT}\"",
        path.display()
    )]
    TooManyBytes {
        /// The scene file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// The text is wrong at a line.
    #[error("{file}, line {line}: {what}")]
    Line {
        /// The scene file, or "scene" for a text in memory.
        file: String,
        /// Line, counted from 1.
        line: usize,
        /// The defect and its remedy.
        what: String,
    },
    /// A material that cannot be resolved.
    #[error(transparent)]
    Material(MaterialError),
    /// A label volume could not be read, or lacks a label that the scene uses.
    #[error(transparent)]
    Labels(#[from] LabelError),
    /// A surface file of this region could not be read.
    #[error("region \"{0}\": {1}")]
    Surface(String, #[source] SurfaceError),
    /// A surface was read but is unusable.
    #[error("region \"{region}\", surface {}: {source}", path.display())]
    Check {
        /// The region.
        region: String,
        /// Its surface file.
        path: PathBuf,
        /// Its defect.
        source: SurfaceError,
    },
}
