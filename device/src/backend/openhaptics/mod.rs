//! Touch and Phantom devices, through their maker's library `libHD` (OpenHaptics).
//!
//! The library comes with the maker's developer edition and is not built in: it is loaded when a device is opened.
//! Its servo thread calls back a thousand times a second, so its clock drives the device. The callback reads,
//! writes the newest force and publishes the newest state; [`OpenHaptics`] never waits for it. A force without
//! renewal for 20 turns fades to zero in 20 more.
//!
//! Devices have the names of the maker's setup program; without a name the default one is opened. The library has
//! one scheduler, so one device per program is driven. Forces along the three axes are rendered, torques of the
//! 6-DOF models are not.

mod device;
mod error;
mod frame;
mod parameter;
mod sys;
mod turn;

use std::path::Path;

pub use device::OpenHaptics;

use self::sys::Api;
use super::found::Found;
use crate::OpenError;

/// Finds the device of this name, or the default one: opened for a moment, without force. The library has no list
/// of devices.
///
/// `library` is the file to load; without one the system's search path applies.
pub fn find(library: Option<&Path>, name: Option<&str>) -> Result<Found, OpenError> {
    let api = Api::load(library)?;
    let handle = device::init(&api, name)?;
    let (model, serial) = (api.text(parameter::MODEL), api.text(parameter::SERIAL));
    api.disable_device(handle);
    Ok(Found {
        id: device::called(name).to_owned(),
        name: format!("{model}, serial number {serial}"),
        is_free: true,
    })
}

/// Opens the device of this name, or the default one.
pub fn open(library: Option<&Path>, name: Option<&str>) -> Result<OpenHaptics, OpenError> {
    OpenHaptics::open(library, name)
}
