//! One message of a 6-DOF mouse.
//!
//! The first byte is the kind; numbers are 16 bits, the lower byte first:
//!
//! | first byte | then | from |
//! | --- | --- | --- |
//! | 1 | three numbers: translation | all |
//! | 1 | six numbers: translation, rotation | newer devices, in place of 1 and 2 |
//! | 2 | three numbers: rotation | older devices, after each 1 |
//! | 3 | one to four bytes: a bit per button | all |
//!
//! Other messages (0x17, the battery) do not concern the hand. Sources: report descriptors and captured messages of
//! a SpaceNavigator and a SpaceMouse Wireless.

use nalgebra::Vector3;
use thiserror::Error;

use crate::Buttons;

/// Value of a full deflection, both ways: the logical range of the report descriptors. Caps under a hard push
/// exceed it.
pub const FULL: f64 = 350.0;

/// The longest message that is read, bytes; a USB device at full speed sends no longer one.
pub const REPORT_BYTES_MAX: usize = 64;

/// The most buttons, in bytes.
const BUTTON_BYTES_MAX: usize = 4;

/// Content of a message, in the device's own axes; 1 is a full deflection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Report {
    /// The cap is pushed.
    Push(Vector3<f64>),
    /// The cap is twisted.
    Twist(Vector3<f64>),
    /// Both in one message.
    Both {
        /// How it is pushed.
        push: Vector3<f64>,
        /// How it is twisted.
        twist: Vector3<f64>,
    },
    /// These buttons are held and no others. Bit 0 is the left one, or the first of the device's own numbering.
    Buttons(Buttons),
}

/// A truncated message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a message of the 6-DOF mouse is truncated")]
pub struct BadReport;

impl Report {
    /// Parses `bytes`; `None` for a message that does not concern the hand.
    pub fn parse(bytes: &[u8]) -> Result<Option<Self>, BadReport> {
        let (&id, rest) = bytes.split_first().ok_or(BadReport)?;
        Ok(match id {
            1 => {
                let push = numbers(rest).ok_or(BadReport)?;
                // Some systems pad a message to the maximum length; fewer bytes than a rotation are padding.
                Some(match rest.get(6..).and_then(numbers) {
                    Some(twist) => Self::Both { push, twist },
                    None => Self::Push(push),
                })
            }
            2 => Some(Self::Twist(numbers(rest).ok_or(BadReport)?)),
            3 if rest.is_empty() => return Err(BadReport),
            3 => {
                let bits = rest.iter().take(BUTTON_BYTES_MAX).rev();
                let bits = bits.fold(0, |bits: u32, &byte| bits << 8 | u32::from(byte));
                Some(Self::Buttons(Buttons::from_bits(bits)))
            }
            _ => None,
        })
    }
}

/// Three numbers, each within −1 and 1.
fn numbers(bytes: &[u8]) -> Option<Vector3<f64>> {
    let number = |i: usize| {
        let pair = [*bytes.get(2 * i)?, *bytes.get(2 * i + 1)?];
        Some((f64::from(i16::from_le_bytes(pair)) / FULL).clamp(-1.0, 1.0))
    };
    Some(Vector3::new(number(0)?, number(1)?, number(2)?))
}
