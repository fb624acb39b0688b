//! Devices of Force Dimension (delta, omega, sigma) and the Novint Falcon, through their maker's library.
//!
//! The library is `libdrd`, with `libdhd` in it. The SDK is free for owners at forcedimension.com and not built in:
//! it is loaded when a device is opened. Its calls return at once, so our clock drives it. Its units are metres,
//! newtons and radians.
//!
//! Its frame is x towards the user, y to the right and z up. [`Dhd`] uses x to the right, y away from the user and
//! z up, as all drivers here.
//!
//! A device needs calibration after power-on. [`calibrate`](crate::HapticDevice::calibrate) starts it: the device
//! moves by itself for some seconds, so keep hands off.

mod device;
mod error;
mod models;
mod sys;

use std::path::Path;

pub use device::Dhd;

use self::sys::Api;
use super::found::{Found, choose};
use crate::OpenError;

/// Remedy when no device is found.
const HINT: &str = "look at its cable and power, and see that you may use USB devices (the SDK's manual has a udev rule)";

/// Lists the plugged-in devices. Each is opened for a moment, without force, to read its name; a device in use by
/// another program is listed by its number.
///
/// `library` is the file to load; without one the system's search path applies.
pub fn find(library: Option<&Path>) -> Result<Vec<Found>, OpenError> {
    list(&Api::load(library)?)
}

fn list(api: &Api) -> Result<Vec<Found>, OpenError> {
    let count = api
        .count()
        .map_err(|code| refused(api, "count devices", code))?;
    Ok((0..count).map(|index| name_of(api, index)).collect())
}

fn name_of(api: &Api, index: usize) -> Found {
    if api.open(index).is_err() {
        return Found {
            id: index.to_string(),
            name: format!("not free: {}", api.last_words()),
            is_free: false,
        };
    }
    let found = Found {
        id: api.serial().map_or(index.to_string(), |s| s.to_string()),
        name: api.name(),
        is_free: true,
    };
    api.close();
    found
}

/// Opens the device with this id, or the only one.
pub fn open(library: Option<&Path>, which: Option<&str>) -> Result<Dhd, OpenError> {
    let api = Api::load(library)?;
    let found = list(&api)?;
    let index = choose("dhd", HINT, &found, which)?;
    api.open(index)
        .map_err(|code| refused(&api, "open the device", code))?;
    Ok(Dhd::new(api))
}

fn refused(api: &Api, what: &str, error::Code(code): error::Code) -> OpenError {
    let words = api.last_words();
    OpenError::new(format_args!(
        "the maker's library failed to {what}: {words} (its code {code}); look at cable and power, close \
         other programs that use the device, and see that you may use USB devices"
    ))
}
