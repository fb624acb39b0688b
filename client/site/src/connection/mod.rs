//! The participant's seat across connections, and its requests.

mod backoff;
mod reconnector;
mod requests;
mod stroke_refusals;

pub use backoff::{BUSY_WAIT_FIRST, Backoff, Retry};
pub use reconnector::{Action, ConnectionStatus, Farewell, Reconnector};
pub use stroke_refusals::StrokeRefusals;
