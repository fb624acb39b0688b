//! A bad network on one machine: a relay for UDP that delays, loses, doubles and reorders.
//!
//! ```text
//! client <-> relay's listening socket <-> one socket per client <-> server
//! ```
//!
//! What happens to a packet is decided by a pure function, [`Fates::fate`], of the seed, the flow
//! (which client), the direction and the packet's number: the same profile and seed give the same
//! fates. The sockets and the threads around it are in [`Relay`]. It needs no privileges and no
//! queueing discipline of the kernel, and it never looks into a packet.

mod fate;
mod profile;
mod socket;
mod stats;

pub use fate::{Direction, Fate, Fates};
pub use profile::{Bursts, Jitter, Profile, UnknownProfile};
pub use socket::{CLIENTS_MAX, QUEUE_MAX_PACKETS, Relay};
pub use stats::RelayStats;
