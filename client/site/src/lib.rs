//! One participant's site.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod connection;
mod replica;
mod site;
mod tools;

pub use connection::{Action, ConnectionStatus, Farewell, Reconnector};
pub use replica::{
    CutNews, CutOrder, Drift, HAPTIC_PERIOD, Prefetch, Replica, ReplicaError, ThinCounters,
    ThinView, VIEW_TOLERANCE, View, ViewCut, hand_budget,
};
pub use site::{
    OperationRecord, RESYNCS_MAX, Site, SiteCounters, SiteError, ViewFrame, ViewNews, grid_index,
    grid_moment,
};
pub use tools::{Reach, Roster, StrokeCollector, ToolAt, tissue_stroke};
