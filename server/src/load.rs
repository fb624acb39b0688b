//! Loads the model of a session from a model file, a scene or a sample.

use std::path::Path;
use std::time::Instant;

use palpate_anatomy::SceneInput;
use palpate_anatomy::sample::Sample;
use palpate_tissue::Model;
use palpate_tissue::file::{ModelFile, decode_model, encode_model};

use crate::ServerError;
use crate::build::build_model;

/// A model with its encoding for clients.
pub(crate) struct Loaded {
    pub(crate) model: Model,
    pub(crate) bytes: Vec<u8>,
}

/// Loads or builds the model named `what`.
pub(crate) fn load(what: &str) -> Result<Loaded, ServerError> {
    let ModelFile { model, .. } = model_file(what)?;
    // The server decodes the same bytes as the clients, so all start from equal bits.
    let bytes = encode_model(&model);
    let model = decode_model(&bytes)?;
    Ok(Loaded { model, bytes })
}

/// Loads or builds the model named `what`, with its report.
pub(crate) fn model_file(what: &str) -> Result<ModelFile, ServerError> {
    let path = Path::new(what);
    if path.extension().is_some_and(|e| e == "palp") {
        Ok(ModelFile::read(path)?)
    } else if path.extension().is_some_and(|e| e == "toml") {
        build_input(&SceneInput::load(path)?)
    } else if path.exists() {
        Err(ServerError::NoModel(format!(
            "{what} is neither a model file (.palp) nor a scene (.toml); \
             `palpate-server build SCENE.toml -o FILE.palp` makes a model file"
        )))
    } else {
        let sample: Sample = what.parse().map_err(|error| {
            ServerError::NoModel(format!("there is no file {what} and {error}"))
        })?;
        build_input(&sample.input()?)
    }
}

fn build_input(input: &SceneInput) -> Result<ModelFile, ServerError> {
    let (file, summary) = build_model(input, Instant::now())?;
    for warning in &summary.report.warnings {
        tracing::warn!("{warning}");
    }
    Ok(file)
}
