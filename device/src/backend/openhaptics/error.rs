//! What the library calls wrong, in the numbers of the public header `hdDefines.h`.

use thiserror::Error;

use crate::Faults;
use crate::backend::library::LibraryError;

/// Why a Touch or Phantom can not be opened.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum OpenHapticsError {
    /// The maker's library is missing or unfit.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// A name with a zero in it.
    #[error(
        "the name {0:?} can not be that of a device; give it as it stands in the maker's setup program"
    )]
    Name(String),
    /// The library refused.
    #[error(
        "the device {name} can not be opened: {words} (code {code:#06x}); look at cable and power, and see in the maker's \
         setup program that a device of this name is set up and paired"
    )]
    Refused {
        /// The name it was asked for by.
        name: String,
        /// What the library says.
        words: String,
        /// Its code.
        code: u32,
    },
    /// The library's thread does not call.
    #[error("the device {name} was opened and says nothing; unplug it, plug it in and try again")]
    Silent {
        /// The name it was asked for by.
        name: String,
    },
}

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
    /// One more.
    pub(super) fn add(&mut self, code: u32) {
        match code {
            WARM_MOTORS => self.faults = self.faults.with(Faults::MOTORS_WARM),
            code if FORCE_ERRORS.contains(&code) => {
                self.faults = self.faults.with(Faults::OVER_FORCE);
            }
            DEVICE_FAULT | COMM_ERROR => self.lost = true,
            _ => self.faults = self.faults.with(Faults::COMMUNICATION),
        }
    }
}
