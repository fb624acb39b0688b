//! One folder per driver, and shared parts; `steered` is shared by the drivers that steer a tool.
//!
//! A driver's own frame is x to the right, y away from the user and z up, with the maker's origin;
//! [`Placed`](crate::Placed) transforms it into the scene.

pub mod dhd;
pub mod five_dof;
mod found;
pub mod gamepad;
pub mod haply;
mod library;
mod mailbox;
pub mod openhaptics;
pub mod pointer;
pub mod replay;
pub mod sim;
pub mod spacemouse;
pub mod steered;

pub use found::Found;
