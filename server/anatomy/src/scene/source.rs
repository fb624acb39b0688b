//! Source of the shape of a region.

use std::path::{Path, PathBuf};

use crate::surface::Unit;

/// A closed surface, or labels of a volume. Files are as the scene gives them (see
/// [`super::Scene::source_path`]).
#[derive(Debug, Clone, PartialEq)]
pub enum RegionSource {
    /// `surface = "FILE.stl"`.
    Surface {
        /// STL, OBJ or PLY.
        file: PathBuf,
        /// The unit the file is written in.
        unit: Unit,
    },
    /// `label = 3` or `label = [3, 4]`.
    Labels {
        /// NIfTI, NRRD, or a DICOM series.
        file: PathBuf,
        /// The labels, as the scene gives them.
        labels: Vec<u16>,
    },
}

impl RegionSource {
    /// The file, as the scene gives it.
    pub fn file(&self) -> &Path {
        match self {
            Self::Surface { file, .. } | Self::Labels { file, .. } => file,
        }
    }
}
