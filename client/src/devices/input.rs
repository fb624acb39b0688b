//! Devices that a hand steers: opening what this program was built with.

use palpate_device::HapticDevice;
use palpate_device::backend::steered::Space;

use super::{DeviceError, DeviceKind};

/// Opens the first device of this kind that is connected, and steers a tool in `space` with it.
pub(super) fn open(kind: DeviceKind, space: &Space) -> Result<Box<dyn HapticDevice>, DeviceError> {
    match kind {
        DeviceKind::Pointer => Err(DeviceError::NeedsView),
        #[cfg(feature = "spacemouse")]
        DeviceKind::SpaceMouse => {
            use palpate_device::backend::{spacemouse, steered::RateControl};
            Ok(Box::new(spacemouse::open(RateControl::default(), space)?))
        }
        #[cfg(feature = "gamepad")]
        DeviceKind::Gamepad => {
            use palpate_device::backend::gamepad;
            Ok(Box::new(gamepad::open(gamepad::rate(), space)?))
        }
        // Without a feature nothing asks where the tool may go.
        other => {
            let _ = space;
            Err(DeviceError::BuiltWithout(other.word()))
        }
    }
}
