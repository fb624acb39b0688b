//! The error of this crate.

use std::fmt::Display;
use std::io;
use std::path::Path;

/// Why an input was rejected or a file was not written: one sentence with the place, the cause, the offending value and
/// the remedy. Programs print it and none acts on the kind of defect, so there is one type for all inputs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct InputError(String);

impl InputError {
    pub(crate) fn new(what: impl Display) -> Self {
        Self(what.to_string())
    }

    /// About a file.
    pub(crate) fn of(path: &Path, what: impl Display) -> Self {
        Self(format!("{}: {what}", path.display()))
    }

    /// An error of the operating system about a file to be read.
    pub(crate) fn io(path: &Path) -> impl Fn(io::Error) -> Self + '_ {
        move |e| {
            Self::of(
                path,
                format_args!("{e}; check the path and that the file is readable"),
            )
        }
    }
}

impl From<palpate_tissue::file::WriteError> for InputError {
    fn from(e: palpate_tissue::file::WriteError) -> Self {
        Self::new(e)
    }
}

impl From<palpate_tissue::material::MaterialError> for InputError {
    fn from(e: palpate_tissue::material::MaterialError) -> Self {
        Self::new(e)
    }
}
