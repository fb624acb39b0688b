//! A bad network, as pure machines: what becomes of a packet is a matter of the profile, the seed,
//! the flow, the direction, the packet's number and the time at which it is sent, and of nothing
//! else.
//!
//! | to | look in |
//! | --- | --- |
//! | say what a network is like, in code or in a TOML file | [`Profile`], [`Link`] |
//! | know what becomes of one packet after the other | [`Path`] |
//! | let pure machines talk to each other in virtual time | [`VirtualNetwork`] |
//! | let a site's clock be wrong | [`VirtualClock`] |
//!
//! A packet meets, in this order:
//!
//! ```text
//! outage -> bottleneck and its queue -> loss -> delay, jitter, burst, trace -> order -> copy, flipped bits
//! ```
//!
//! The relay for real sockets, [`relay`](crate::relay), stands on the same [`Path`].

mod checked;
pub(crate) mod command;
mod draw;
mod link;
mod path;
mod profile;
mod spread;
mod trace;
mod virtual_clock;
mod virtual_network;

#[cfg(test)]
mod laws;

pub use link::{Bursts, Jitter, Link, Outage, Outages, Rate, Step, Steps};
pub use path::{
    Arrival, Arrivals, Corruption, DELAY_MAX_MS, Direction, HEADER_BYTES, Path, PathCounts,
};
pub use profile::{Profile, ProfileError};
pub use spread::Spread;
pub use trace::{TRACE_ROWS_MAX, Trace, TraceError, TraceRow};
pub use virtual_clock::VirtualClock;
pub use virtual_network::{Delivery, FLOWS_MAX, PACKETS_MAX, VirtualNetwork};
