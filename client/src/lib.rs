//! The participant's program: a device at 1 kHz, a replica of the tissue, and the session.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod devices;
mod network;
mod program;
pub mod realtime;
pub mod recording;
mod replica;

pub use devices::{DeviceError, DeviceKind, OwnedError, Sources, tool_description};
pub use program::{
    ClientError, EventCounts, JoinOptions, SolveTimes, StartAt, StatusKind, Summary, cli, run,
};
pub use realtime::Lateness;
pub use recording::Recording;
