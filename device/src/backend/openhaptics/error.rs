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

/// A parameter, value, operation or type that this model does not know. Whoever asks a model of three degrees of freedom
/// for turns gets one each frame, and the frame is as good as without the question.
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
    /// One more.
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
    fn what_a_model_does_not_know_is_no_fault_and_hides_none() {
        assert_eq!(of(0x0100..=0x0103), Errors::default());
        assert_eq!(of([0x0100, 0x0201]).faults, Faults::OVER_FORCE);
        assert!(of([0x0100, 0x0302]).lost);
    }

    #[test]
    fn what_is_not_known_here_forbids_force() {
        for code in [0x0104, 0x0301, 0x0900] {
            assert!(of([code]).faults.forbid_force(), "{code:#x}");
        }
    }
}
