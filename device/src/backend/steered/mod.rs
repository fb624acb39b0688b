//! A tool that is steered: the hand deflects a cap or a stick, and the tool moves at a speed that follows from it.
//!
//! What the drivers of such devices share. A [`Source`] waits for what the hand does, on a thread of its own; the
//! deflections cross over to the force loop without a lock ([`Controls`]), and [`Steering`] makes a pose of them.
//!
//! - [`RateControl`], [`Steering`]: deflection to speed, speed to pose, within a workspace.
//! - [`Source`], [`News`]: what a driver brings.
//! - [`Steered`]: all of it as a [`HapticDevice`](crate::HapticDevice) that renders no force. Where the hardware
//!   rumbles, the force on the tool comes back as a hint ([`Rumble`]).

mod controls;
mod device;
mod driver;
mod rumble;
mod steering;
#[cfg(test)]
mod tests;

pub use controls::Controls;
pub use device::{Kind, OpenError, Space, Steered};
pub use driver::{Gone, News, REOPEN_EVERY, Source};
pub use rumble::Rumble;
pub use steering::{BadRate, PAUSE_MAX_US, RateControl, Steering};
