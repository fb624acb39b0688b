//! One folder per driver, and what drivers share.
//!
//! A driver's own frame is x to the right, y away from the user and z up, with the origin where the maker has it;
//! [`Placed`](crate::Placed) puts it into the scene.

pub mod dhd;
mod exchange;
pub mod five_dof;
mod found;
pub mod haply;
mod library;
pub mod openhaptics;
pub mod replay;
pub mod sim;

pub use found::{Choice, Found};
pub use library::LibraryError;
