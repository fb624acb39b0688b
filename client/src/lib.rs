//! The participant's program: a device at 1 kHz, a replica of the tissue, and the session.
//!
//! The server alone decides cuts. Each client computes forces from its own replica, so no force crosses the network
//! and the network never delays the hand.
//!
//! ```text
//! haptics thread   realtime   reads the device, writes the force                  1 kHz
//! motion thread    network    sends the hand's samples to session and replica     250 Hz
//! replica thread   replica    other tools, operations, two shapes of the tissue   250 Hz
//! network thread   network    drives the session; never waits for the replica
//! main thread      program    status line, signals, shutdown
//! ```
//!
//! [`run`] is the whole program as a function. The state machines behind replica and network are in `palpate-site`.
//!
//! ```no_run
//! use palpate_client::{JoinOptions, run};
//!
//! let link = "palpate://192.168.1.20:4433/spectator?cert=...&grant=...";
//! let summary = run(&JoinOptions::new(link, "Ada"))?;
//! println!("{summary}");
//! # Ok::<(), palpate_client::ClientError>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod devices;
mod network;
mod page;
mod program;
pub mod realtime;
pub mod recording;
mod replica;

pub use devices::{DeviceError, DeviceKind, Sources, tool_description};
pub use program::{
    ClientError, EventCounts, JoinOptions, LINK_VARIABLE, LinkSourceError, SolveTimes, StartAt,
    StatusKind, Summary, cli, run,
};
pub use realtime::Lateness;
pub use recording::Recording;
