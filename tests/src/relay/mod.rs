//! A bad network on one machine: a UDP relay with delay, loss, duplication and reordering.
//!
//! ```text
//! client <-> relay's listening socket <-> one socket per client <-> server
//! ```
//!
//! A [`Path`](crate::network::Path) decides the fate of every packet, as in virtual time: equal profile and
//! seed give equal fates. [`Relay`] has the sockets and threads. It needs no privileges and no kernel queueing
//! discipline, and does not inspect payloads.

pub(crate) mod command;
mod socket;
mod stats;

#[cfg(test)]
mod delay_tests;
#[cfg(test)]
mod tests;

pub use crate::network::Profile;
pub use socket::Relay;
pub use stats::RelayStats;
