//! The model under test: a file, scene or sample, stored in a model file once.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{InputError, SceneInput, build};
use palpate_tissue::{FileError, Material, Model, ModelFile, WriteError, block};

use crate::progress::Progress;

/// Failure to prepare a model.
#[derive(Debug, thiserror::Error)]
pub enum TestModelError {
    /// Neither a file nor a sample.
    #[error("\"{name}\" is not a file, and {source}")]
    Unknown {
        /// The requested name.
        name: String,
        /// Error of the sample lookup.
        source: InputError,
    },
    /// A file that is neither a model nor a scene.
    #[error("unsupported file {}: use a model (.palp) or a scene (.toml)", .0.display())]
    Kind(PathBuf),
    /// The scene is invalid, or can not be built.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The model file is invalid.
    #[error(transparent)]
    File(#[from] FileError),
    /// The model file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// A model with its file.
#[derive(Debug, Clone)]
pub struct TestModel {
    /// The model.
    pub model: Arc<Model>,
    /// The file for the server.
    pub file: PathBuf,
}

/// A block of soft tissue on a pinned base.
pub fn soft_block(cells: [usize; 3], spacing_m: f64) -> Model {
    let soft = Material {
        name: "soft".into(),
        young_pa: 1e4,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "a block for experiments".into(),
        ..Material::default()
    };
    block(cells, spacing_m, &soft, 1)
}

impl TestModel {
    /// The model `name`: a `.palp` file as it is; a `.toml` scene or a sample, built into `dir`.
    pub fn prepare(name: &str, dir: &Path) -> Result<Self, TestModelError> {
        let path = Path::new(name);
        let ends_with = |end: &str| path.extension().is_some_and(|e| e == end);
        if ends_with("palp") {
            let model = ModelFile::read(path)?.model;
            return Ok(Self {
                model: Arc::new(model),
                file: path.to_owned(),
            });
        }
        if ends_with("toml") {
            return Self::build(&SceneInput::load(path)?, dir);
        }
        match name.parse::<Sample>() {
            Ok(sample) => Self::build(&sample.input()?, dir),
            Err(_) if path.exists() => Err(TestModelError::Kind(path.to_owned())),
            Err(source) => Err(TestModelError::Unknown {
                name: name.to_owned(),
                source,
            }),
        }
    }

    /// The model `name` alone, without its file.
    pub(crate) fn in_memory(name: &str, progress: &mut Progress) -> Result<Arc<Model>, String> {
        let dir = tempfile::tempdir()
            .map_err(|e| format!("cannot create a temporary folder for models: {e}"))?;
        progress.stage(&format!("preparing the model \"{name}\""));
        let built = Self::prepare(name, dir.path()).map_err(|e| e.to_string())?;
        Ok(built.model)
    }

    fn build(input: &SceneInput, dir: &Path) -> Result<Self, TestModelError> {
        let (model, report) = build(input, &mut |_, _| ())?;
        let report_json = serde_json::to_string(&report).expect("a report is plain data");
        Self::write(ModelFile { model, report_json }, dir)
    }

    /// An in-memory model, written into `dir`.
    pub fn of(model: Model, dir: &Path) -> Result<Self, TestModelError> {
        let report_json = String::new();
        Self::write(ModelFile { model, report_json }, dir)
    }

    fn write(file: ModelFile, dir: &Path) -> Result<Self, TestModelError> {
        let path = dir.join("model.palp");
        file.write(&path)?;
        Ok(Self {
            model: Arc::new(file.model),
            file: path,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::TestModel;

    #[test]
    fn unknown_model_error_lists_the_samples() {
        let dir = tempfile::tempdir().unwrap();
        let error = TestModel::prepare("thight", dir.path())
            .unwrap_err()
            .to_string();
        assert!(error.contains("did you mean \"thigh\"?"), "{error}");
        let file = dir.path().join("notes.txt");
        std::fs::write(&file, "x").unwrap();
        let error = TestModel::prepare(&file.display().to_string(), dir.path()).unwrap_err();
        assert!(error.to_string().contains(".palp"), "{error}");
    }

    #[test]
    fn sample_round_trips_through_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let made = TestModel::prepare("handle", dir.path()).unwrap();
        let name = made.file.display().to_string();
        let read = TestModel::prepare(&name, dir.path()).unwrap();
        assert_eq!(made.model.nodes.len(), read.model.nodes.len());
    }
}
