//! Steered input devices: opening those that this program was built with.

use palpate_device::backend::pointer::{Pointer, PointerConfig};
use palpate_device::backend::steered::Space;

use super::{DeviceError, DeviceKind, HeldDevice, Opened};

/// Kinds that can be searched for, best first: a 6-DOF mouse rotates the tool about every axis at once.
const KINDS: [DeviceKind; 2] = [DeviceKind::SpaceMouse, DeviceKind::Gamepad];

/// The best kind with a connected device. These devices can only be detected by opening them.
pub(super) fn best() -> Option<DeviceKind> {
    KINDS.into_iter().find(|kind| {
        let opened = open(*kind, &HeldDevice::new(*kind, None).space());
        opened.map(|mut opened| opened.device.close()).is_ok()
    })
}

/// Opens the first connected device of this kind, which then steers a tool in `space`.
pub(super) fn open(kind: DeviceKind, space: &Space) -> Result<Opened, DeviceError> {
    match kind {
        DeviceKind::Pointer => {
            let (device, handle) = Pointer::new(&PointerConfig::new(space.workspace, space.start))?;
            Ok(Opened {
                device: Box::new(device),
                pointer: Some(handle),
            })
        }
        #[cfg(feature = "spacemouse")]
        DeviceKind::SpaceMouse => {
            use palpate_device::backend::{spacemouse, steered::RateControl};
            Ok(Opened::new(spacemouse::open(
                RateControl::default(),
                space,
            )?))
        }
        #[cfg(feature = "gamepad")]
        DeviceKind::Gamepad => {
            use palpate_device::backend::gamepad;
            Ok(Opened::new(gamepad::open(gamepad::rate(), space)?))
        }
        other => Err(DeviceError::BuiltWithout(other.word())),
    }
}
