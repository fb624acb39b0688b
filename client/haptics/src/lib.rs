//! One tick of the 1 kHz loop: from the newest contact model and the newest sample to a wrench that is safe for the
//! hand.
//!
//! This crate never allocates, locks, logs, waits, reads a clock or accesses a device. [`Chain::tick`] takes the
//! time and a sample and returns a wrench. A chain owns all its state; the caller passes each contact model by
//! value (the client through a triple buffer).
//!
//! Signs: every force and torque is the one ON THE TOOL, and so on the hand. Normals point out of the tissue, so
//! that a pressed tool has a positive normal force. Forces are in newtons, torques in newton metres about the
//! tool's pivot, along the scene's axes, without a tuning gain.
//!
//! The order of the stages, one file each:
//!
//! ```text
//! not-a-number check -> contact model, without contact if a blade has begun or ended a cut since (chain)
//!   -> blended (blend, contact_law) with slopes that hand and device can follow (coupling)
//!   -> stick-slip friction of every contact point (friction), summed to a wrench about the pivot (contact_points)
//!   -> clamp to the device's continuous force and its torque -> soft start x watchdog -> passivity -> slew limit
//! ```
//!
//! The slew limit is last, so that no stage and no fault can make a step at the hand.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod blend;
mod chain;
mod contact;
mod contact_law;
mod contact_points;
mod coupling;
mod energy;
mod events;
mod friction;
mod limits;
mod motion;
mod passivity;
mod proxy;
mod soft_start;
mod touch;
mod watchdog;

pub use chain::{Chain, ChainConfig, Tick};
pub use contact::{CONTACTS_MAX, ContactModel};
pub use events::{Counters, Events};
pub use friction::FrictionConfig;
pub use touch::{MINDLIN, Touch};
pub use watchdog::WatchdogConfig;

pub(crate) use coupling::Coupling;
pub(crate) use energy::EnergyObserver;
pub(crate) use friction::{Contact, Friction, Grip};
pub(crate) use limits::{Slew, StiffnessCap, WrenchSlew, clamp_force};
pub(crate) use passivity::Passivity;
pub(crate) use soft_start::SoftStart;
pub(crate) use watchdog::{LinkGuard, Watchdog};
