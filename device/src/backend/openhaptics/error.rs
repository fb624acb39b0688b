//! Errors of the library, in the numbers of the public header `hdDefines.h`.

use crate::Faults;

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
