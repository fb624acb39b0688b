//! Touch and Phantom devices, through their maker's library `libHD` (OpenHaptics).
//!
//! The library comes with the maker's developer edition and is not built in: it is loaded when a device is opened. It
//! calls back from a servo thread of its own, a thousand times a second, so its clock drives the device: the callback
//! reads, writes the newest force and hands the newest state over; [`OpenHaptics`] never waits for it. A force that our
//! loop has not renewed for 20 turns fades to nothing in 20 more.
//!
//! Devices have the names that the maker's setup program gave them; without a name the default one is meant. One device
//! per program is driven, as the library has one scheduler. Forces along the three axes are rendered, torques of the 6-DOF
//! models are not.

mod device;
mod error;
mod frame;
mod parameter;
mod sys;
mod turn;

use std::path::Path;

pub use device::OpenHaptics;
pub use error::OpenHapticsError;

use self::sys::Api;
use super::found::Found;

/// The device of this name, or the default one: opened for a moment, without force. The library has no list of them.
///
/// `library` is the file to load; without one the system looks for it.
///
/// # Errors
///
/// When the library is missing or unfit, or the device does not open.
pub fn find(library: Option<&Path>, name: Option<&str>) -> Result<Found, OpenHapticsError> {
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
///
/// # Errors
///
/// When the library is missing or unfit, or the device does not open or says nothing.
pub fn open(library: Option<&Path>, name: Option<&str>) -> Result<OpenHaptics, OpenHapticsError> {
    OpenHaptics::open(library, name)
}
