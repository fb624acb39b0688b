//! An open device.

use palpate_device::HapticDevice;
use palpate_device::backend::pointer::PointerHandle;

/// An open device, and the sender of its events if it is a pointer.
pub(crate) struct Opened {
    pub(crate) device: Box<dyn HapticDevice>,
    pub(crate) pointer: Option<PointerHandle>,
}

impl Opened {
    /// A device that gets its motion by itself.
    pub(super) fn new(device: impl HapticDevice + 'static) -> Self {
        Self {
            device: Box::new(device),
            pointer: None,
        }
    }
}
