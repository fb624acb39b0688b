//! Emulated network as pure state machines. The fate of a packet depends only on the profile, the seed, the
//! flow, the direction, the packet number and the send time.
//!
//! | to | look in |
//! | --- | --- |
//! | describe a network, in code or in a TOML file | [`Profile`], [`Link`] |
//! | compute the fate of each packet | [`Path`] |
//!
//! A packet passes these stages in order:
//!
//! ```text
//! outage -> bottleneck and its queue -> loss -> delay, jitter, burst, trace -> order -> copy, flipped bits
//! ```
//!
//! The relay for real sockets, `relay`, and simulated sessions use
//! the same [`Path`].

mod checked;
pub(crate) mod command;
mod draw;
mod event_queue;
mod link;
mod path;
mod profile;
mod spread;
mod trace;

#[cfg(test)]
mod tests;

pub(crate) use draw::standard_normal;
pub(crate) use event_queue::EventQueue;
pub use link::{Bursts, Jitter, Link, Outage, Outages, Rate, Step, Steps};
pub use path::{
    Arrival, Arrivals, Corruption, DELAY_MAX_MS, Direction, HEADER_BYTES, Path, PathCounts,
};
pub use profile::Profile;
pub use spread::Spread;
pub use trace::Trace;
