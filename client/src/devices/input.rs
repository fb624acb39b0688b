//! Devices that a hand steers: opening what this program was built with.

use palpate_device::HapticDevice;
use palpate_device::backend::steered::Space;

use super::{DeviceError, DeviceKind, Hold};

/// The kinds that can be looked for, the best first: a 6-DOF mouse turns the tool about every axis at once.
const KINDS: [DeviceKind; 2] = [DeviceKind::SpaceMouse, DeviceKind::Gamepad];

/// The best kind of which one is connected. To know it is to open it: there is nothing else that these say of themselves.
pub(super) fn best() -> Option<DeviceKind> {
    KINDS.into_iter().find(|kind| {
        let opened = open(*kind, &Hold::new(*kind, None).space());
        opened.map(|mut device| device.close()).is_ok()
    })
}

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
