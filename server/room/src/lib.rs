//! One authoritative session as a pure state machine: participants, tools, cuts and the operation log.
//!
//! [`Room`] owns participants and the log; [`Authority`] and [`Cutter`] own the tissue. They exchange
//! [`TissueOrder`] and [`TissueReport`], so that a server can run each on its own thread.
//!
//! This crate opens no socket, reads no clock and spawns no thread. It is the only crate that knows both wire types
//! and tissue types, and converts between them.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod admission;
mod authority;
mod config;
mod control_state;
mod convert;
mod cut_budget;
mod cut_queue;
mod fan_out;
mod invitations;
mod joins;
mod limits;
mod log;
mod open_strokes;
mod participant;
mod pictures;
mod request_history;
mod room;
mod shown_motion;
mod simulated;
#[cfg(test)]
mod tests;
mod track;

pub use authority::{
    Authority, CutJob, CutOrder, Cutter, LoggedCut, RequestedChange, Settling, TickReport,
    TissueOrder, TissueReport,
};
pub use config::{RoomConfig, SEATS_MAX};
pub use invitations::Invitation;
pub use limits::{Limit, LimitCounters};
pub use log::TopologyState;
pub use room::{Output, PeerKey, Room, SeatFigures, ToolShown};
pub use simulated::SimulatedRoom;
