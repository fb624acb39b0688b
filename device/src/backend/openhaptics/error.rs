//! Errors of the library, in the numbers of the public header `hdDefines.h`.

use thiserror::Error;

use crate::Faults;
use crate::backend::library::LibraryError;

/// Why a Touch or Phantom can not be opened.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum OpenHapticsError {
    /// The maker's library is missing or unusable.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// A name with a NUL character.
    #[error("invalid device name {0:?}; use the name in the maker's setup program")]
    Name(String),
    /// The library reported an error.
    #[error(
        "the device {name} can not be opened: {words} (code {code:#06x}); look at cable and power, and see in the maker's \
         setup program that a device of this name is set up and paired"
    )]
    Refused {
        /// The requested name.
        name: String,
        /// The library's text.
        words: String,
        /// Its code.
        code: u32,
    },
    /// The library's servo thread does not call back.
    #[error("the device {name} was opened but sends no state; unplug it, plug it in and try again")]
    Silent {
        /// The requested name.
        name: String,
    },
}

/// Unknown parameter, value, operation or type of this model. A query for orientation on a model of three degrees
/// of freedom causes one per frame, and the frame is still valid.
const INVALID: std::ops::RangeInclusive<u32> = 0x0100..=0x0103;
const WARM_MOTORS: u32 = 0x0200;
const FORCE_ERRORS: std::ops::RangeInclusive<u32> = 0x0201..=0x0204;
const DEVICE_FAULT: u32 = 0x0300;
const COMM_ERROR: u32 = 0x0302;

/// Errors of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Errors {
    pub(super) faults: Faults,
    /// The device is gone or broken.
    pub(super) lost: bool,
}

impl Errors {
    /// Adds an error.
    pub(super) fn add(&mut self, code: u32) {
        match code {
            code if INVALID.contains(&code) => {}
            WARM_MOTORS => self.faults = self.faults.with(Faults::MOTORS_WARM),
            code if FORCE_ERRORS.contains(&code) => {
                self.faults = self.faults.with(Faults::OVER_FORCE);
            }
            DEVICE_FAULT | COMM_ERROR => self.lost = true,
            _ => self.faults = self.faults.with(Faults::COMMUNICATION),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Errors;
    use crate::Faults;

    fn of(codes: impl IntoIterator<Item = u32>) -> Errors {
        let mut errors = Errors::default();
        codes.into_iter().for_each(|code| errors.add(code));
        errors
    }

    #[test]
    fn unsupported_queries_are_no_fault_and_hide_none() {
        assert_eq!(of(0x0100..=0x0103), Errors::default());
        assert_eq!(of([0x0100, 0x0201]).faults, Faults::OVER_FORCE);
        assert!(of([0x0100, 0x0302]).lost);
    }

    #[test]
    fn unknown_errors_forbid_force() {
        for code in [0x0104, 0x0301, 0x0900] {
            assert!(of([code]).faults.forbid_force(), "{code:#x}");
        }
    }
}
