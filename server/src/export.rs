//! A model as files for other programs, from `build` and from `inspect`.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use palpate_tissue::export::{stage_stl, stage_vtu};
use palpate_tissue::{Model, Shape, Staged, Topology, WriteError};

/// Which files beside the model itself.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Exports {
    /// Also write the cells as a VTK unstructured grid (lengths in mm)
    #[arg(long, value_name = "FILE.vtu")]
    vtu: Option<PathBuf>,
    /// Also write the outer surface, that of each region and those between regions as STL (mm)
    #[arg(long, value_name = "DIR")]
    stl: Option<PathBuf>,
}

impl Exports {
    /// Whether anything is asked for.
    pub(crate) fn any(&self) -> bool {
        self.vtu.is_some() || self.stl.is_some()
    }

    /// Writes what is asked for, without putting it in its place yet.
    pub(crate) fn stage(&self, model: &Model) -> Result<Vec<Staged>, WriteError> {
        let mut staged = Vec::new();
        if !self.any() {
            return Ok(staged);
        }
        let topology = Topology::new(Arc::new(model.clone()));
        let rest = Shape::rest(&topology);
        if let Some(path) = &self.vtu {
            staged.push(stage_vtu(&topology, &rest, path)?);
        }
        if let Some(folder) = &self.stl {
            staged.extend(stage_stl(&topology, &rest, folder)?);
        }
        Ok(staged)
    }
}

/// Puts files in place when all of them are complete.
pub(crate) fn put_in_place(staged: Vec<Staged>) -> Result<(), WriteError> {
    staged.into_iter().try_for_each(Staged::put_in_place)
}
