//! Numbers of the public header `hdDefines.h`, with units.

/// One bit per button.
pub(super) const BUTTONS: u32 = 0x2000;
/// mm.
pub(super) const POSITION: u32 = 0x2050;
/// mm/s.
pub(super) const VELOCITY: u32 = 0x2051;
/// 16 numbers, column after column, mm.
pub(super) const TRANSFORM: u32 = 0x2052;
/// rad/s.
pub(super) const ANGULAR_VELOCITY: u32 = 0x2053;
/// A text.
pub(super) const MODEL: u32 = 0x2501;
/// A text.
pub(super) const SERIAL: u32 = 0x2504;
/// Two corners, mm.
pub(super) const MAX_WORKSPACE: u32 = 0x2550;
/// A number.
pub(super) const INPUT_DOF: u32 = 0x2553;
/// Bits: 1 resets encoders, 2 is automatic, 4 is by the inkwell.
pub(super) const CALIBRATION_STYLE: u32 = 0x2555;
/// Hz.
pub(super) const UPDATE_RATE: u32 = 0x2600;
/// N/mm.
pub(super) const MAX_STIFFNESS: u32 = 0x2602;
/// N.
pub(super) const MAX_FORCE: u32 = 0x2603;
/// N.
pub(super) const MAX_CONTINUOUS_FORCE: u32 = 0x2604;
/// N.
pub(super) const FORCE: u32 = 0x2700;

/// Whether forces are rendered.
pub(super) const FORCE_OUTPUT: u32 = 0x4000;
/// Whether forces beyond the limit are clamped, instead of being an error that switches them off.
pub(super) const MAX_FORCE_CLAMPING: u32 = 0x4001;

/// The device is calibrated.
pub(super) const CALIBRATION_OK: u32 = 0x5000;
/// The device has found a better reference, and applies it on request.
pub(super) const CALIBRATION_NEEDS_UPDATE: u32 = 0x5001;
