//! Mouse, touch and keyboard through a view: the tool follows the pointer, without force.
//!
//! A view computes the target pose of the tool and sends it ([`PointerEvent`]) through a [`PointerHandle`], without
//! locks or waits. The device moves there at the loop's rate. It renders no force; a view shows the force as an arrow.
//!
//! - [`Follower`]: smooth motion to the target within the speed limits.
//! - [`Pointer`]: the tool as a [`HapticDevice`](crate::HapticDevice).

mod device;
mod event;
mod follower;
mod handle;
#[cfg(test)]
mod tests;

pub use device::{Pointer, PointerConfig};
pub use event::PointerEvent;
pub use follower::{Follower, RATE_PER_S};
pub use handle::{EVENTS_MAX, PointerFull, PointerHandle};
