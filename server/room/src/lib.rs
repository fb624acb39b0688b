//! One authoritative session as a pure machine: who is in it, what they hold, what has been cut, in
//! which order everything happened.
//!
//! [`Room`] owns participants and the log, [`Authority`] and [`Cutter`] own the tissue; they meet through
//! [`TissueOrder`] and [`TissueReport`], so that a server can run each on a thread of its own.
//!
//! This crate never opens a socket, never reads a clock and never spawns. It is the only one that
//! knows both the words on the wire and the tissue, and converts between them.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod asked;
mod authority;
mod config;
mod convert;
mod fan_out;
mod log;
mod participant;
mod pictures;
mod room;
mod simulated;
#[cfg(test)]
mod tests;

pub use authority::{
    Authority, CutJob, CutOrder, Cutter, LoggedCut, PreparedCut, Settling, TickReport, TissueOrder,
    TissueReport,
};
pub use config::{RoomConfig, SEATS_MAX};
pub use room::{Output, PeerKey, Room};
pub use simulated::SimulatedRoom;
