//! Steered input devices: opening those that this program was built with.

use palpate_device::HapticDevice;
use palpate_device::backend::steered::Space;

use super::{DeviceError, DeviceKind, HeldDevice};

/// Kinds that can be searched for, best first: a 6-DOF mouse rotates the tool about every axis at once.
const KINDS: [DeviceKind; 2] = [DeviceKind::SpaceMouse, DeviceKind::Gamepad];

/// The best kind with a connected device. These devices can only be detected by opening them.
pub(super) fn best() -> Option<DeviceKind> {
    KINDS.into_iter().find(|kind| {
        let opened = open(*kind, &HeldDevice::new(*kind, None).space());
        opened.map(|mut device| device.close()).is_ok()
    })
}

/// Opens the first connected device of this kind, which then steers a tool in `space`.
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
        // Without these features `space` is unused.
        other => {
            let _ = space;
            Err(DeviceError::BuiltWithout(other.word()))
        }
    }
}
