//! Mouse and keyboard through a view: the tool follows the pointer, without force.
//!
//! A view sends pointer events ([`PointerEvent`]) through a [`PointerHandle`], without locks or waits. The device
//! converts them to poses at the loop's rate. It renders no force; a view shows the force as an arrow.
//!
//! - [`View`], [`PointerEvent`]: position of the pointer, in the frame of the scene.
//! - [`Aim`]: the target pose of the tool.
//! - [`Follower`]: smooth motion to the target within the speed limits.
//! - [`Pointer`]: all of it as a [`HapticDevice`](crate::HapticDevice).

mod aim;
mod device;
mod event;
mod follower;
mod handle;
#[cfg(test)]
mod tests;

pub use aim::{Aim, FINE, TURN_RAD_PER_M};
pub use device::{Pointer, PointerConfig};
pub use event::{Modifiers, PointerEvent, View};
pub use follower::{Follower, RATE_PER_S};
pub use handle::{EVENTS_MAX, PointerFull, PointerHandle};
