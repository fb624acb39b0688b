//! The boards of the device: six counters in, six converters out.

use thiserror::Error;

use crate::{Buttons, DeviceFault, DeviceTime};

/// Numbers for the six motors: θ1, θ2, θ3 of the left arm, then those of the right arm.
pub type Six = [i32; 6];

/// The boards between this program and the device. A real port accesses their registers; both calls return within a
/// small part of a millisecond.
pub trait Port: Send {
    /// The counters of the encoders.
    fn counts(&mut self, now: DeviceTime) -> Result<Six, PortFault>;

    /// Puts codes on the converters, which hold them until the next call.
    fn command(&mut self, now: DeviceTime, codes: Six) -> Result<(), PortFault>;

    /// The buttons of a handle or a pedal, where there are any.
    fn buttons(&mut self, _now: DeviceTime) -> Buttons {
        Buttons::NONE
    }

    /// Whether the counters have counted from the posture of calibration since the boards were switched on.
    fn is_homed(&self) -> bool;

    /// Sets the counters to these numbers: the arms stand in the posture of calibration.
    fn set_counts(&mut self, counts: Six) -> Result<(), PortFault>;

    /// Releases the boards, with zero on the converters. A second call does nothing.
    fn close(&mut self);
}

/// Failure of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum PortFault {
    /// It does not answer.
    #[error("the boards of the device do not answer")]
    Gone,
    /// It answered with an error.
    #[error("a board of the device reported error {0}")]
    Board(i32),
}

impl From<PortFault> for DeviceFault {
    fn from(fault: PortFault) -> Self {
        match fault {
            PortFault::Gone => Self::Unplugged,
            PortFault::Board(code) => Self::Driver { code },
        }
    }
}
