//! One authoritative session as a pure state machine: participants, tools, cuts and the operation log.
//!
//! [`Room`] owns participants and the log; [`Authority`] and [`Cutter`] own the tissue. They exchange
//! [`TissueOrder`] and [`TissueReport`], so that a server can run each on its own thread.
//!
//! This crate opens no socket, reads no clock and spawns no thread. It is the only crate that knows both wire types
//! and tissue types, and converts between them.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod authority;
mod config;
mod convert;
mod cut_budget;
mod cut_queue;
mod fan_out;
mod joins;
mod limits;
mod log;
mod participant;
mod pictures;
mod request_history;
mod room;
mod simulated;
#[cfg(test)]
mod tests;
mod track;

pub use authority::{
    Authority, CutJob, CutOrder, Cutter, LoggedCut, PreparedCut, Settling, TickReport, TissueOrder,
    TissueReport,
};
pub use config::{RoomConfig, SEATS_MAX};
pub use limits::{Limit, LimitCounters};
pub use room::{Output, PeerKey, Room};
pub use simulated::SimulatedRoom;
