//! Safe wrappers of the C functions of libdrd and libdhd.
//!
//! Types and numbers are those of the public headers `dhdc.h` and `drdc.h` (SDK 3.7 to 3.17). A device's number is
//! a C `char` there; it is passed as an `int`, which holds it on every machine. After opening, all calls use -1,
//! the device opened last, because some releases return another number from opening.

use std::ffi::{c_char, c_int, c_uint};
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::error::Code;
use crate::backend::library::sys::{functions, text};
use crate::backend::library::{Library, Wanted};
use crate::{OpenError, Wrench};

/// The library's names on this system, and how to install it.
const WANTED: Wanted = Wanted {
    what: "the Force Dimension SDK (libdrd)",
    names: if cfg!(windows) {
        &["drd64.dll", "drd.dll"]
    } else if cfg!(target_os = "macos") {
        &["libdrd.dylib", "libdrd.3.dylib"]
    } else {
        &["libdrd.so", "libdrd.so.3", "libdrd.so.2"]
    },
    how: "Download the SDK from forcedimension.com, unpack it, and let the system find its library: copy it to \
          /usr/local/lib and run ldconfig, or name it in PALPATE_LIBDRD.",
};

/// The device that was opened last.
const LAST: c_int = -1;

type Int = unsafe extern "system" fn(c_int) -> c_int;
type Bool = unsafe extern "system" fn(c_int) -> bool;
type Three = unsafe extern "system" fn(*mut f64, *mut f64, *mut f64, c_int) -> c_int;

functions! {
    WANTED;
    count: unsafe extern "system" fn() -> c_int = "dhdGetDeviceCount",
    open: Int = "drdOpenID",
    close: Int = "drdClose",
    system_type: Int = "dhdGetSystemType",
    system_name: unsafe extern "system" fn(c_int) -> *const c_char = "dhdGetSystemName",
    serial: unsafe extern "system" fn(*mut c_uint, c_int) -> c_int = "dhdGetSerialNumber",
    last_error: unsafe extern "system" fn() -> c_int = "dhdErrorGetLast",
    last_words: unsafe extern "system" fn() -> *const c_char = "dhdErrorGetLastStr",
    position: Three = "dhdGetPosition",
    velocity: Three = "dhdGetLinearVelocity",
    turn: unsafe extern "system" fn(*mut [[f64; 3]; 3], c_int) -> c_int = "dhdGetOrientationFrame",
    turning: Three = "dhdGetAngularVelocityRad",
    buttons: unsafe extern "system" fn(c_int) -> c_uint = "dhdGetButtonMask",
    has_wrist: Bool = "dhdHasWrist",
    has_gripper: Bool = "dhdHasGripper",
    gripper: unsafe extern "system" fn(*mut f64, c_int) -> c_int = "dhdGetGripperAngleRad",
    force: unsafe extern "system" fn(f64, f64, f64, f64, f64, f64, f64, c_int) -> c_int
        = "dhdSetForceAndTorqueAndGripperForce",
    enable: unsafe extern "system" fn(u8, c_int) -> c_int = "dhdEnableForce",
    is_initialised: Bool = "drdIsInitialized",
    initialise: Int = "drdAutoInit",
    stop: unsafe extern "system" fn(bool, c_int) -> c_int = "drdStop",
}

impl Api {
    /// Negative results are errors. Positive ones are not: 1 marks the same value within a control period, 2 a
    /// saturated motor.
    fn checked(&self, returned: c_int) -> Result<c_int, Code> {
        if returned < 0 {
            // SAFETY: takes nothing and returns a number.
            Err(Code(unsafe { (self.last_error)() }))
        } else {
            Ok(returned)
        }
    }

    /// The library's text for its last error.
    pub(super) fn last_words(&self) -> String {
        // SAFETY: takes nothing and returns a text of the library's own, or null.
        unsafe { text((self.last_words)()) }
    }

    /// Number of plugged-in devices.
    pub(super) fn count(&self) -> Result<usize, Code> {
        // SAFETY: takes nothing and returns a number.
        self.checked(unsafe { (self.count)() }).map(|n| n as usize)
    }

    /// Opens device `index`; all other calls now refer to it.
    pub(super) fn open(&self, index: usize) -> Result<(), Code> {
        // SAFETY: takes a number.
        self.checked(unsafe { (self.open)(index as c_int) })
            .map(|_| ())
    }

    pub(super) fn close(&self) {
        // SAFETY: takes a number. The result no longer matters.
        let _ = unsafe { (self.close)(LAST) };
    }

    /// The model, in the numbers of the header.
    pub(super) fn system_type(&self) -> c_int {
        // SAFETY: takes a number.
        unsafe { (self.system_type)(LAST) }
    }

    pub(super) fn name(&self) -> String {
        // SAFETY: takes a number and returns a text of the library's own, or null.
        unsafe { text((self.system_name)(LAST)) }
    }

    /// Its serial number, if any. Releases differ in the width of the number; it is written to the beginning.
    pub(super) fn serial(&self) -> Option<u32> {
        let mut number: c_uint = 0;
        // SAFETY: the pointer is valid for four bytes; the widest release writes four.
        let returned = unsafe { (self.serial)(&raw mut number, LAST) };
        (returned >= 0 && number != 0).then_some(u32::from_le(number))
    }

    fn three(&self, function: Three) -> Result<Vector3<f64>, Code> {
        let mut v = [0.0; 3];
        let [x, y, z] = &mut v;
        // SAFETY: three valid pointers to doubles, as all functions of this type take.
        self.checked(unsafe { function(x, y, z, LAST) })?;
        Ok(Vector3::from(v))
    }

    /// Position of the effector, m, in the device's own frame.
    pub(super) fn position(&self) -> Result<Vector3<f64>, Code> {
        self.three(self.position)
    }

    /// Velocity, m/s.
    pub(super) fn velocity(&self) -> Result<Vector3<f64>, Code> {
        self.three(self.velocity)
    }

    /// Angular velocity, rad/s.
    pub(super) fn turning(&self) -> Result<Vector3<f64>, Code> {
        self.three(self.turning)
    }

    /// Orientation.
    pub(super) fn turn(&self) -> Result<Matrix3<f64>, Code> {
        let mut rows = [[0.0; 3]; 3];
        // SAFETY: a valid pointer to nine doubles, row after row.
        self.checked(unsafe { (self.turn)(&raw mut rows, LAST) })?;
        Ok(Matrix3::from_fn(|i, j| rows[i][j]))
    }

    /// Its buttons, one bit each.
    pub(super) fn buttons(&self) -> u32 {
        // SAFETY: takes a number.
        unsafe { (self.buttons)(LAST) }
    }

    /// Whether the device senses orientation.
    pub(super) fn has_wrist(&self) -> bool {
        // SAFETY: takes a number.
        unsafe { (self.has_wrist)(LAST) }
    }

    pub(super) fn has_gripper(&self) -> bool {
        // SAFETY: takes a number.
        unsafe { (self.has_gripper)(LAST) }
    }

    /// Opening of the gripper, rad.
    pub(super) fn gripper(&self) -> Result<f64, Code> {
        let mut rad = 0.0;
        // SAFETY: a valid pointer to a double.
        self.checked(unsafe { (self.gripper)(&raw mut rad, LAST) })?;
        Ok(rad)
    }

    /// Sets force (N) and torque (N·m) in the device's own frame, and no force on the gripper; returns whether a
    /// motor is saturated.
    pub(super) fn push(&self, wrench: &Wrench) -> Result<bool, Code> {
        let (f, t) = (wrench.force, wrench.torque);
        // SAFETY: takes numbers.
        let returned = unsafe { (self.force)(f.x, f.y, f.z, t.x, t.y, t.z, 0.0, LAST) };
        Ok(self.checked(returned)? == 2)
    }

    /// Switches the motors.
    pub(super) fn enable(&self, on: bool) -> Result<(), Code> {
        // SAFETY: takes numbers.
        self.checked(unsafe { (self.enable)(u8::from(on), LAST) })
            .map(|_| ())
    }

    /// Whether the device is calibrated.
    pub(super) fn is_initialised(&self) -> bool {
        // SAFETY: takes a number.
        unsafe { (self.is_initialised)(LAST) }
    }

    /// Calibrates; the device moves by itself for some seconds.
    pub(super) fn initialise(&self) -> Result<(), Code> {
        // SAFETY: takes a number.
        let done = self.checked(unsafe { (self.initialise)(LAST) });
        // The library's own control holds the device afterwards; a hand could not move it.
        // SAFETY: takes a truth value and a number.
        let released = self.checked(unsafe { (self.stop)(false, LAST) });
        done.and(released).map(|_| ())
    }
}
