//! How a run ended, and whether that is an error.

use palpate_protocol::session::CloseReason;

use crate::realtime::LoopSummary;
use crate::{ClientError, Summary};

/// Why the main thread stopped supervising.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ending {
    /// The participant left.
    Wish(String),
    /// The session ended.
    Closed(CloseReason),
    /// The server no longer has the seat.
    SeatGone(String),
    /// The replica differs from the server.
    Diverged(String),
    /// A thread of this program panicked.
    Panicked(&'static str),
}

/// Converts an ending into the result of the run.
pub(super) fn conclude(
    ending: Ending,
    mut summary: Summary,
    haptics: Option<&LoopSummary>,
) -> Result<Summary, ClientError> {
    let mut end = |sentence: String| {
        summary.ended = sentence;
        Box::new(std::mem::take(&mut summary))
    };
    if let Some(panic) = haptics.and_then(|h| h.panicked.as_ref()) {
        let detail = format!("the force loop panicked and the force was set to zero: {panic}");
        let summary = end(detail.clone());
        return Err(ClientError::Broken { detail, summary });
    }
    match ending {
        Ending::Wish(sentence) => Ok(*end(sentence)),
        Ending::Closed(reason @ (CloseReason::Left | CloseReason::Goodbye(_))) => {
            Ok(*end(reason.to_string()))
        }
        Ending::Closed(CloseReason::ConnectionLost(detail)) => {
            let summary = end(format!("connection to the server lost: {detail}"));
            Err(ClientError::ServerLost { detail, summary })
        }
        Ending::SeatGone(detail) => {
            let summary = end(format!("the server no longer has the seat: {detail}"));
            Err(ClientError::SeatGone { detail, summary })
        }
        Ending::Diverged(detail) => {
            let summary = end(format!("the replica differs from the server: {detail}"));
            Err(ClientError::Diverged { detail, summary })
        }
        Ending::Closed(reason) => {
            let detail = reason.to_string();
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
        Ending::Panicked(which) => {
            let detail = format!("the {which} panicked; this is a bug in the program");
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
    }
}
