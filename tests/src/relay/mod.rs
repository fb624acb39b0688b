//! A bad network on one machine: a relay for UDP that delays, loses, doubles and reorders.
//!
//! ```text
//! client <-> relay's listening socket <-> one socket per client <-> server
//! ```
//!
//! What happens to a packet is what a [`Path`](crate::network::Path) says of it, the same as in
//! virtual time: the same profile and seed give the same fates. The sockets and the threads around
//! it are in [`Relay`]. It needs no privileges and no queueing discipline of the kernel, and it
//! never looks into a packet.

pub(crate) mod command;
mod socket;
mod stats;

#[cfg(test)]
mod delay_laws;
#[cfg(test)]
mod laws;

pub use crate::network::{Direction, Profile};
pub use socket::{CLIENTS_MAX, QUEUE_MAX_PACKETS, RebindError, Relay};
pub use stats::{RelayStats, WayStats};
