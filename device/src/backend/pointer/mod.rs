//! Mouse and keyboard through a view: the tool is where the pointer is, and no force.
//!
//! A view hands over what happens to the pointer ([`PointerEvent`]) on a [`PointerHandle`]; nothing in it locks or
//! waits. The device makes poses of it at the loop's own rate. It renders no force; a view shows the force as
//! an arrow.
//!
//! - [`View`], [`PointerEvent`]: where the pointer is, in the frame of the scene.
//! - [`Aim`]: where the tool is meant to be after it.
//! - [`Follower`]: how it gets there, smoothly and no faster than it may.
//! - [`Pointer`]: all of it as a [`HapticDevice`](crate::HapticDevice).

mod aim;
mod device;
mod event;
mod follower;
mod handle;
#[cfg(test)]
mod tests;

pub use aim::{Aim, FINE, TURN_RAD_PER_M};
pub use device::{BadPointer, Pointer, PointerConfig};
pub use event::{Modifiers, PointerEvent, View};
pub use follower::{Follower, RATE_PER_S};
pub use handle::{EVENTS_MAX, PointerCounts, PointerFull, PointerHandle};
