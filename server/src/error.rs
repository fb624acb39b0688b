//! Errors of the server's commands.

use palpate_anatomy::InputError;
use palpate_tissue::file::{FileError, WriteError};
use palpate_transport::TransportError;

/// Error of a command of the server.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// A scene, a surface, a label volume or a sample is not usable.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The model file can not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file can not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The network can not be used.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The certificate of the page can not be used.
    #[error(transparent)]
    PageTls(#[from] palpate_transport::PageTlsError),
    /// The page can not be served.
    #[error(transparent)]
    View(#[from] palpate_view::ViewError),
    /// The identity of the host can not be used or kept.
    #[error("the host's identity {} can not be used: {why}", path.display())]
    Identity {
        /// Its file.
        path: std::path::PathBuf,
        /// Problem and remedy, without any secret.
        why: String,
    },
    /// A strict build deviates from its input.
    #[error(
        "{0} deviations of the model from its input, or of the input itself; nothing was written. Mend the input, choose a \
         smaller spacing_mm, set thresholds in [report], or leave out --strict"
    )]
    Deviations(usize),
    /// The name is neither a model file, nor a scene, nor a sample.
    #[error("{0}")]
    NoModel(String),
    /// An option is invalid, independent of any file.
    #[error("{0}")]
    CommandLine(String),
    /// An option does not fit the contents of a file.
    #[error("{0}")]
    Option(String),
    /// An operation of the system failed.
    #[error("{doing}: {source}")]
    Io {
        /// The failed action.
        doing: String,
        /// Error of the system.
        source: std::io::Error,
    },
}
