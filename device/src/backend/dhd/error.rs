//! Errors of the library.

use crate::{DeviceFault, Rejection};

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
