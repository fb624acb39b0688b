//! The participant's seat across connections, and its requests.

mod reconnector;
mod requests;

pub use reconnector::{Action, ConnectionStatus, Farewell, Reconnector};
