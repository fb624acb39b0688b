//! A steered tool: the deflection of a cap or a stick sets the velocity of the tool (rate control).
//!
//! The shared part of such drivers. A [`Source`] waits for the hand's controls on its own thread; a lock-free
//! buffer passes them to the force loop ([`Controls`]), and [`Steering`] integrates them to a pose.
//!
//! - [`RateControl`], [`Steering`]: deflection to speed, speed to pose, within a workspace.
//! - [`Source`], [`SourceEvent`]: the part of each driver.
//! - [`Steered`]: all of it as a [`HapticDevice`](crate::HapticDevice) that renders no force. Where the hardware
//!   rumbles, the force on the tool becomes a cue ([`Rumble`]).

mod controls;
mod device;
mod driver;
mod rumble;
mod steering;
#[cfg(test)]
mod tests;

pub use controls::Controls;
pub use device::{Kind, Space, Steered};
#[cfg(any(feature = "gamepad", feature = "spacemouse"))]
pub(super) use device::{no_search, not_found};
pub use driver::{DeviceLost, REOPEN_EVERY, Source, SourceEvent};
pub use rumble::Rumble;
pub use steering::{PAUSE_MAX_US, RateControl, Steering};
