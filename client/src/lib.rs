//! The participant's program: a device at 1 kHz, a replica of the tissue, and the session.
//!
//! The server alone decides cuts. Each client computes forces from its own replica, so no force crosses the network
//! and the network never delays the hand.
//!
//! ```text
//! haptics thread   realtime        reads the device, writes the force                  1 kHz
//! motion thread    motion          sends the hand's samples to session and replica     250 Hz
//! replica thread   replica_thread  other tools, operations, two shapes of the tissue   250 Hz
//! network thread   network         drives the session; never waits for the replica
//! main thread      join            status line, signals, shutdown
//! ```
//!
//! [`run`] is the whole program as a function. [`Replica`], [`Site`] and their parts are pure (no thread, no clock),
//! so that tests can run them in virtual time.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod cli;
mod contact_model;
pub mod convert;
mod devices;
mod ending;
mod error;
mod history;
mod inbox;
mod join;
mod motion;
mod network;
mod options;
pub mod prefetch;
mod reach;
pub mod realtime;
mod reconnect;
pub mod recording;
pub mod replica;
mod replica_thread;
pub mod requests;
pub mod roster;
mod seat;
mod session;
pub mod site;
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
