//! Why an Inverse3 can not be opened.

use thiserror::Error;

use crate::backend::found::SelectionError;

/// Reason why an Inverse3 can not be opened, as a sentence for users.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum HaplyError {
    /// An invalid address.
    #[error("invalid address of a Haply service: {0:?}; use a form like ws://localhost:10001")]
    Address(String),
    /// No server listens there.
    #[error(
        "no Haply service answers at {url} ({why}): install the Haply Hub or the Haply Inverse Service from haply.co, and start it"
    )]
    NotRunning {
        /// The address tried.
        url: String,
        /// The system's error.
        why: String,
    },
    /// Another kind of server listens there.
    #[error(
        "the server at {url} is not a WebSocket server ({why}); is another program on that port?"
    )]
    NoWebSocket {
        /// The address tried.
        url: String,
        /// The error.
        why: String,
    },
    /// The service sends no message.
    #[error("the Haply service at {url} sends nothing; restart it")]
    Silent {
        /// Its address.
        url: String,
    },
    /// The service sends another kind of message.
    #[error("the service at {url} does not send the inventory of a Haply service: {why}")]
    Unfit {
        /// Its address.
        url: String,
        /// The error in the message.
        why: String,
    },
    /// No device is plugged in, or the choice is ambiguous.
    #[error(transparent)]
    SelectionError(#[from] SelectionError),
    /// The system could not start a thread.
    #[error("the system did not start a thread for the Haply service: {0}")]
    Thread(String),
}
