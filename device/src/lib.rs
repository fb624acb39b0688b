//! The haptic device trait, one folder per driver, and a simulated hand without hardware.
//!
//! This crate has no access to tissue, network or a clock (time is an argument) and computes no force: it reports
//! the pose of the hand and passes a wrench to the motors.
//!
//! - [`HapticDevice`] is the trait; [`DeviceCaps`] lists the capabilities of a device, [`ClockOwner`] the owner of
//!   its clock.
//! - [`backend::sim`] is a hand model that follows a [`Script`] and responds to force; [`backend::five_dof`] the
//!   device of 2007, with its kinematics and simulated boards.
//! - [`backend::haply`], [`backend::openhaptics`] and [`backend::dhd`] drive commercial devices through their
//!   makers' service or library.
//! - [`backend::spacemouse`], [`backend::gamepad`] and [`backend::pointer`] steer a tool and render no force;
//!   [`HapticDevice::cue`] passes them the force on the tool.
//! - [`conformance`] is the suite that every backend passes.
//!
//! Units are SI: metres, seconds, kilograms, newtons, newton metres, radians. Millimetres appear
//! in script files only.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod backend;
pub mod conformance;
mod device;
mod error;
mod motors;
mod placed;
mod sample;
pub mod script;
pub mod text_file;
mod time;

pub use device::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, ForceState, HapticDevice, Rejection,
    Workspace, Written,
};
pub use error::{OpenError, ScriptError};
pub use placed::{Placed, Placement};
pub use sample::{Buttons, Faults, Pose, Sample, Wrench};
pub use script::Script;
pub use time::DeviceTime;
