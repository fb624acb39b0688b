//! Why an Inverse3 can not be opened.

use thiserror::Error;

use crate::backend::found::Choice;

/// Why an Inverse3 can not be opened: a sentence each, for people.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum HaplyError {
    /// The address is none.
    #[error("{0:?} is no address of a Haply service; it looks like ws://localhost:10001")]
    Address(String),
    /// Nobody listens there.
    #[error(
        "no Haply service answers at {url} ({why}): install the Haply Hub or the Haply Inverse Service from haply.co, and start it"
    )]
    NotRunning {
        /// Where it was looked for.
        url: String,
        /// What the system said.
        why: String,
    },
    /// Somebody else listens there.
    #[error("what answers at {url} is no WebSocket ({why}); is another program on that port?")]
    NoWebSocket {
        /// Where it was looked for.
        url: String,
        /// What was wrong.
        why: String,
    },
    /// It says nothing.
    #[error("the Haply service at {url} says nothing; restart it")]
    Silent {
        /// Where it listens.
        url: String,
    },
    /// It says something else.
    #[error("what the service at {url} says is not the inventory of a Haply service: {why}")]
    Unfit {
        /// Where it listens.
        url: String,
        /// What is wrong with it.
        why: String,
    },
    /// None is plugged in, or it is not clear which is meant.
    #[error(transparent)]
    Choice(#[from] Choice),
    /// The system gave no thread.
    #[error("the system did not start a thread for the Haply service: {0}")]
    Thread(String),
}
