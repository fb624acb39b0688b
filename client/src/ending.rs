//! How a run ended, and whether that is as it should be.

use palpate_protocol::session::CloseReason;

use crate::realtime::LoopSummary;
use crate::{ClientError, Summary};

/// Why the main thread stopped looking.
pub(crate) enum Ending {
    /// The participant wanted it so.
    Wish(String),
    /// The session is over.
    Closed(CloseReason),
    /// The copy is not the server's.
    Diverged(String),
    /// One of our threads broke.
    Panicked(&'static str),
}

/// What an ending means.
pub(crate) fn conclude(
    ending: Ending,
    mut summary: Summary,
    haptics: Option<&LoopSummary>,
) -> Result<Summary, ClientError> {
    let mut end = |sentence: String| {
        summary.ended = sentence;
        Box::new(std::mem::take(&mut summary))
    };
    if let Some(panic) = haptics.and_then(|h| h.panicked.as_ref()) {
        let detail = format!("the force loop failed and the force was taken away: {panic}");
        let summary = end(detail.clone());
        return Err(ClientError::Broken { detail, summary });
    }
    match ending {
        Ending::Wish(sentence) => Ok(*end(sentence)),
        Ending::Closed(reason @ (CloseReason::Left | CloseReason::Goodbye(_))) => {
            Ok(*end(reason.to_string()))
        }
        Ending::Closed(CloseReason::ConnectionLost(detail)) => {
            let summary = end(format!("the server is gone: {detail}"));
            Err(ClientError::ServerLost { detail, summary })
        }
        Ending::Diverged(detail) => {
            let summary = end(format!("the copy of the tissue differs: {detail}"));
            Err(ClientError::Diverged { detail, summary })
        }
        Ending::Closed(reason) => {
            let detail = reason.to_string();
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
        Ending::Panicked(which) => {
            let detail = format!("the {which} failed; this is a fault of the program");
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
    }
}
