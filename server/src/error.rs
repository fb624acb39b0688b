//! What can go wrong before or while serving.

use palpate_tissue::sample::SampleError;
use palpate_tissue::{BuildError, FileError, LabelError, SceneError, WriteError};
use palpate_transport::TransportError;

/// Why a command of the server ended without its result.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The scene or one of its surfaces is not usable.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The label volume is not usable.
    #[error(transparent)]
    Labels(#[from] LabelError),
    /// The model can not be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The model file can not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file can not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The sample can not be written.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// The network can not be used.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The identity of the host can not be used or kept.
    #[error("the host's identity {} can not be used: {why}", path.display())]
    Identity {
        /// Its file.
        path: std::path::PathBuf,
        /// What is wrong and what to do, without any secret.
        why: String,
    },
    /// What was named is neither a file nor a sample.
    #[error("{0}")]
    NoModel(String),
    /// An option does not make sense, whatever the files hold.
    #[error("{0}")]
    CommandLine(String),
    /// An option does not fit what a file holds.
    #[error("{0}")]
    Option(String),
    /// The operating system refused.
    #[error("{doing}: {source}")]
    Io {
        /// What was being done.
        doing: String,
        /// What it said.
        source: std::io::Error,
    },
}
