//! The words on the wire and what they mean in time.
//!
//! This crate never opens a socket, never reads a clock and never spawns: time is an argument,
//! bytes come in through `handle_*` and leave through `poll_*`.

mod time;

pub use time::{ClientTime, ServerTime, Span};
