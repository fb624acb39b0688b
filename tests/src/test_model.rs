//! The model under test: a file, scene or sample, stored in a model file once.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{SceneInput, build};
use palpate_tissue::file::ModelFile;
use palpate_tissue::{Material, Model, block};

use crate::bench::OnStage;

#[derive(Debug, Clone)]
pub struct TestModel {
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
    pub fn prepare(name: &str, dir: &Path) -> Result<Self, String> {
        let path = Path::new(name);
        let ends_with = |end: &str| path.extension().is_some_and(|e| e == end);
        if ends_with("palp") {
            let file = ModelFile::read(path).map_err(|e| e.to_string())?;
            return Ok(Self {
                model: Arc::new(file.model),
                file: path.to_owned(),
            });
        }
        if ends_with("toml") {
            let scene = SceneInput::load(path).map_err(|e| e.to_string())?;
            return Self::build(&scene, dir);
        }
        match name.parse::<Sample>() {
            Ok(sample) => Self::build(&sample.input().map_err(|e| e.to_string())?, dir),
            Err(_) if path.exists() => Err(format!(
                "unsupported file {name}: use a model (.palp) or a scene (.toml)"
            )),
            Err(why) => Err(format!("\"{name}\" is not a file, and {why}")),
        }
    }

    /// The model `name` alone, without its file.
    pub(crate) fn in_memory(name: &str, on_stage: &mut OnStage<'_>) -> Result<Arc<Model>, String> {
        let dir = tempfile::tempdir()
            .map_err(|e| format!("cannot create a temporary folder for models: {e}"))?;
        on_stage(&format!("preparing the model \"{name}\""));
        Ok(Self::prepare(name, dir.path())?.model)
    }

    fn build(input: &SceneInput, dir: &Path) -> Result<Self, String> {
        let (model, report) = build(input, &mut |_, _| ()).map_err(|e| e.to_string())?;
        let report_json = serde_json::to_string(&report).expect("a report is plain data");
        Self::write(ModelFile { model, report_json }, dir)
    }

    pub fn of(model: Model, dir: &Path) -> Result<Self, String> {
        let report_json = String::new();
        Self::write(ModelFile { model, report_json }, dir)
    }

    fn write(file: ModelFile, dir: &Path) -> Result<Self, String> {
        let path = dir.join("model.palp");
        file.write(&path).map_err(|e| e.to_string())?;
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
        let error = TestModel::prepare("thight", dir.path()).unwrap_err();
        assert!(error.contains("did you mean \"thigh\"?"), "{error}");
        let file = dir.path().join("notes.txt");
        std::fs::write(&file, "x").unwrap();
        let error = TestModel::prepare(&file.display().to_string(), dir.path()).unwrap_err();
        assert!(error.contains(".palp"), "{error}");
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
