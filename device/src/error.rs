//! Errors of opening a device and of its files. Programs print them and none acts on the kind of defect, so each is one
//! sentence with the cause, the offending value and the remedy.

use std::fmt::Display;
use std::ops::RangeInclusive;

/// Reason why a device can not be found or opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct OpenError(String);

impl OpenError {
    pub(crate) fn new(what: impl Display) -> Self {
        Self(what.to_string())
    }
}

/// Checks that each number, by its name, is in its range; `of` is what they belong to.
pub(crate) fn check_ranges(
    of: &str,
    numbers: impl IntoIterator<Item = (&'static str, f64, RangeInclusive<f64>)>,
) -> Result<(), OpenError> {
    for (what, found, range) in numbers {
        // Written so that a NaN fails.
        if !range.contains(&found) {
            let (least, most) = range.into_inner();
            return Err(OpenError::new(format_args!(
                "{what} of {of} is {found}, and must be a number from {least} to {most}"
            )));
        }
    }
    Ok(())
}

impl From<ScriptError> for OpenError {
    fn from(e: ScriptError) -> Self {
        Self::new(e)
    }
}

/// Reason for rejecting a script or a recorded motion. The caller names the file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ScriptError(String);

impl ScriptError {
    pub(crate) fn new(what: impl Display) -> Self {
        Self(what.to_string())
    }
}

impl From<std::io::Error> for ScriptError {
    fn from(e: std::io::Error) -> Self {
        Self(format!("can not be read: {e}"))
    }
}
