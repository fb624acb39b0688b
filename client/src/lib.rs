//! The participant's program: a device at 1 kHz, a copy of the tissue, and the session.
//!
//! This crate never decides what is cut (the server does), never sends a force over the network
//! (it computes its own from its copy of the tissue), and never lets the network hold up the hand.
//!
//! ```text
//! haptics thread   realtime   reads the device, writes the force                 1 kHz
//! motion thread    motion     the hand's samples to the session and the replica  250 Hz
//! replica thread   site       other hands, operations, two shapes of the tissue  250 Hz
//! network thread   network    drives the session; nothing in it waits for the replica
//! main thread      join       status line, signals, the end
//! ```
//!
//! [`run`] is the whole program as a function; [`Replica`], [`Site`] and what they stand on are pure
//! (no thread, no clock), so that a laboratory can run them in virtual time.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod ahead;
pub mod cli;
pub mod convert;
mod devices;
mod ending;
mod error;
mod felt;
mod history;
mod inbox;
mod join;
mod lifeline;
mod motion;
mod network;
mod options;
mod reach;
pub mod realtime;
pub mod recording;
pub mod replica;
pub mod requests;
pub mod roster;
mod seat;
mod session;
pub mod site;
mod solve;
mod status;
pub mod stroke;
mod summary;
pub mod thin;
pub mod view;

pub use devices::{DeviceError, DeviceKind, OwnedError, Sources};
pub use error::ClientError;
pub use join::run;
pub use options::{JoinOptions, StartAt, StatusKind};
pub use recording::Recording;
pub use replica::Replica;
pub use roster::{Roster, ToolAt};
pub use site::Site;
pub use summary::{EventCounts, Lateness, SolveTimes, Summary};
