//! The hardware's port: raw HID reports, through the crate hidapi. On Linux without a system library.

use std::ffi::CString;
use std::time::Duration;

use hidapi::{DeviceInfo, HidApi, HidDevice};

use super::{DeviceLost, Port, REPORT_BYTES_MAX, VENDORS, known, over};
use crate::OpenError;
use crate::backend::steered::{RateControl, Space, Steered, no_search, not_found};

const WHAT: &str = "6-DOF mouse";

/// Remedy where the system restricts raw devices.
const PERMISSION: &str = "on Linux a udev rule gives it to whoever sits at the machine: put the line \
     KERNEL==\"hidraw*\", ATTRS{idVendor}==\"256f\", TAG+=\"uaccess\" (and the same with 046d for older devices) into \
     /etc/udev/rules.d/70-spacemouse.rules, and plug it in again";

/// Steers a tool in `space` with the first 6-DOF mouse that is connected.
pub fn open(rate: RateControl, space: &Space) -> Result<Steered, OpenError> {
    let mut api = HidApi::new().map_err(|e| no_search(WHAT, e))?;
    let Found { path, name } = find(&mut api).ok_or_else(|| not_found(WHAT))?;
    let device = api.open_path(&path).map_err(|e| {
        OpenError::new(format_args!(
            "the {name} is connected but can not be opened: {e}; {PERMISSION}"
        ))
    })?;
    let port = Hid {
        api,
        device: Some(device),
    };
    over(port, name, rate, space)
}

/// A mouse that is connected.
struct Found {
    path: CString,
    name: String,
}

fn find(api: &mut HidApi) -> Option<Found> {
    // A failed refresh of the list counts as no device.
    api.reset_devices().ok()?;
    for vendor in VENDORS {
        api.add_devices(vendor, 0).ok()?;
    }
    api.device_list().find_map(found)
}

fn found(info: &DeviceInfo) -> Option<Found> {
    // Old systems report neither page nor usage.
    let usage = Some((info.usage_page(), info.usage())).filter(|u| *u != (0, 0));
    let name = known(info.vendor_id(), info.product_id(), usage)?;
    Some(Found {
        path: info.path().to_owned(),
        name: name.to_owned(),
    })
}

/// The port over raw HID reports.
struct Hid {
    api: HidApi,
    device: Option<HidDevice>,
}

impl Port for Hid {
    fn report(
        &mut self,
        into: &mut [u8; REPORT_BYTES_MAX],
        patience: Duration,
    ) -> Result<usize, DeviceLost> {
        let device = self.device.as_ref().ok_or(DeviceLost)?;
        let patience = i32::try_from(patience.as_millis()).unwrap_or(i32::MAX);
        device.read_timeout(into, patience).map_err(|_| {
            self.device = None;
            DeviceLost
        })
    }

    fn reopen(&mut self) -> bool {
        // Any known mouse is accepted, so that another one can replace it.
        let device = find(&mut self.api).and_then(|found| self.api.open_path(&found.path).ok());
        self.device = device;
        self.device.is_some()
    }
}
