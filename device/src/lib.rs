//! What a haptic device is, one folder per driver, and a simulated hand that is always there.
//!
//! This crate never knows tissue or network, never reads a clock (time is an argument) and never
//! decides a force: it says where the hand is and hands a wrench to the motors.
//!
//! - [`HapticDevice`] is the one trait; [`DeviceCaps`] says what a device can do, [`ClockOwner`]
//!   whose clock drives it.
//! - [`backend::sim`] is a hand model that follows a [`Script`] and feels our force; [`backend::five_dof`] the device
//!   of 2007, with its kinematics and simulated boards.
//! - [`backend::haply`], [`backend::openhaptics`] and [`backend::dhd`] drive what people own, through the service or the
//!   library that their makers give them.
//! - [`backend::spacemouse`], [`backend::gamepad`] and [`backend::pointer`] steer a tool and render no force; they are told
//!   what it would feel ([`HapticDevice::cue`]).
//! - [`conformance`] is the suite that every backend passes.
//!
//! Units are SI: metres, seconds, kilograms, newtons, newton metres, radians. Millimetres appear
//! in script files only.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod backend;
mod clamp;
pub mod conformance;
mod device;
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
pub use placed::{Placed, Placement};
pub use sample::{Buttons, Faults, Pose, Sample, Wrench};
pub use script::{Script, ScriptError};
pub use time::DeviceTime;
