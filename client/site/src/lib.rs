//! One participant's site: replica, view and connection of a session, as pure state machines.
//!
//! ```text
//! connection --ClientEvent--> Reconnector --ClientEvent--> Site --ContactModel--> force loop
//!            <---Hello, Request---------- <--RequestKind--      --ViewFrame-----> view
//!                                                 |
//!                                      Replica: two shapes of the tissue,
//!                                      Roster: the tools of all participants
//! ```
//!
//! Nothing here has a clock, a thread or a socket: time is an argument. The client runs these machines in real time,
//! the laboratory in virtual time.
//!
//! ```
//! use std::sync::Arc;
//!
//! use palpate_protocol::ClientTime;
//! use palpate_site::{Replica, hand_budget};
//! use palpate_tissue::{Material, block};
//!
//! let model = Arc::new(block([4, 4, 4], 4e-3, &Material::default(), 1));
//! let mut replica = Replica::new(model, true);
//! let mut never = || false;
//! let contact = replica.haptic_step(ClientTime::ZERO, None, &[], hand_budget(&mut never));
//! assert!(!contact.in_contact(), "without a tool");
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod connection;
mod replica;
mod site;
#[cfg(test)]
mod test_support;
mod tools;

pub use connection::{
    Action, BUSY_WAIT_FIRST, Backoff, ConnectionStatus, Farewell, Reconnector, Retry,
    StrokeRefusals,
};
pub use replica::{
    CutOrder, Drift, HAPTIC_PERIOD, MadeCut, Prefetch, Replica, ReplicaError, ThinCounters,
    ThinView, VIEW_ITERATIONS, VIEW_TOLERANCE, View, hand_budget, repeat_change,
};
pub use site::{
    Access, HandPose, OperationRecord, RESYNCS_MAX, SessionState, Site, SiteCounters, SiteError,
    ViewFrame, ViewUpdate, grid_index, grid_time,
};
pub use tools::{Reach, Roster, StrokeCollector, ToolAt, tissue_stroke};
