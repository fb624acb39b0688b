//! A model as files for other programs, from `build` and from `inspect`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use palpate_anatomy::export::{stage_stl, stage_vtu};
use palpate_tissue::file::{Staged, WriteError};
use palpate_tissue::{Model, Shape, Topology};

use crate::ServerError;

/// Requested export files.
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
    /// Whether an export is requested.
    pub(crate) fn any(&self) -> bool {
        self.vtu.is_some() || self.stl.is_some()
    }

    /// The requested single files.
    pub(crate) fn files(&self) -> impl Iterator<Item = &Path> {
        self.vtu.as_deref().into_iter()
    }

    /// Writes the requested files beside their destination; [`put_in_place`] moves them.
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

/// Moves the files to their destination once all are complete, unless a destination is one of the files that were `read`.
pub(crate) fn put_in_place(staged: Vec<Staged>, read: &[&Path]) -> Result<(), ServerError> {
    let places: Vec<&Path> = staged.iter().map(Staged::path).collect();
    keep_apart(&places, read)?;
    for file in staged {
        file.put_in_place()?;
    }
    Ok(())
}

/// Rejects destinations that equal an input file or each other.
pub(crate) fn keep_apart(places: &[&Path], read: &[&Path]) -> Result<(), ServerError> {
    let read: Vec<PathBuf> = read.iter().map(|p| resolved(p)).collect();
    let mut taken: Vec<PathBuf> = Vec::new();
    for path in places {
        let place = resolved(path);
        let why = if read.contains(&place) {
            "is an input of this command and would be overwritten"
        } else if taken.contains(&place) {
            "is the destination of two outputs"
        } else {
            taken.push(place);
            continue;
        };
        let path = path.display();
        return Err(ServerError::Option(format!(
            "{path}: {why}; name another file to write"
        )));
    }
    Ok(())
}

/// A canonical path that is equal for all names of one file, whether it exists or not.
fn resolved(path: &Path) -> PathBuf {
    let known = path.canonicalize().ok();
    let beside = || {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
        let folder = folder.unwrap_or(Path::new(".")).canonicalize().ok()?;
        Some(folder.join(path.file_name()?))
    };
    known.or_else(beside).unwrap_or_else(|| path.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_overwrite_neither_inputs_nor_each_other() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir(at("b")).unwrap();
        std::fs::write(at("scene.toml"), "").unwrap();
        let scene = at("scene.toml");
        let around = at("b/../scene.toml");
        let refused = |places: &[&Path]| keep_apart(places, &[&scene]).is_err();
        assert!(refused(&[&scene]));
        assert!(refused(&[&at("x.palp"), &around]));
        assert!(refused(&[&at("x.palp"), &at("b/../x.palp")]));
        assert!(!refused(&[&at("x.palp"), &at("b/x.palp")]));
        assert!(!refused(&[&at("missing/x.palp"), &at("missing/y.palp")]));
    }
}
