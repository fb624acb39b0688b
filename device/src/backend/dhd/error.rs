//! Errors of the library.

use thiserror::Error;

use crate::backend::found::SelectionError;
use crate::backend::library::LibraryError;
use crate::{DeviceFault, Rejection};

/// Why a device of Force Dimension or a Falcon can not be opened.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DhdError {
    /// The maker's library is missing or unusable.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// No device is plugged in, or the choice is ambiguous.
    #[error(transparent)]
    SelectionError(#[from] SelectionError),
    /// The library reported an error.
    #[error(
        "the maker's library failed to {what}: {words} (its code {code}); look at cable and power, close other programs \
             that use the device, and see that you may use USB devices"
    )]
    Refused {
        /// The failed operation.
        what: &'static str,
        /// The library's text.
        words: String,
        /// Its code, from `dhdc.h`.
        code: i32,
    },
}

/// A code of the library, as `dhdErrorGetLast` gives it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Code(pub(super) i32);

impl Code {
    const COMMUNICATION: i32 = 2;
    const NO_DEVICE: i32 = 5;
    const TIMEOUT: i32 = 7;

    fn is_gone(self) -> bool {
        matches!(
            self.0,
            Self::COMMUNICATION | Self::NO_DEVICE | Self::TIMEOUT
        )
    }
}

impl From<Code> for DeviceFault {
    fn from(code: Code) -> Self {
        if code.is_gone() {
            Self::Unplugged
        } else {
            Self::Driver { code: code.0 }
        }
    }
}

impl From<Code> for Rejection {
    fn from(code: Code) -> Self {
        Self::Driver { code: code.0 }
    }
}
