//! Requests of a client: their limits and their rate.

use super::{REQUESTS_PER_SECOND_MAX, ServerPeer};
use crate::request::{Request, RequestKind, RequestRefusal, RequestRefused, ServerMessage};
use crate::session::{CloseReason, PeerEvent};
use crate::{ProtocolError, ServerTime};

impl ServerPeer {
    pub(super) fn handle_request(
        &mut self,
        request: Request,
        now: ServerTime,
    ) -> Result<(), ProtocolError> {
        if !request.kind.is_valid() {
            return Err(ProtocolError::OutOfRange {
                what: "a request",
                detail: format!(
                    "the numbers of {} are not finite, not ordered or too large",
                    request.id
                ),
            });
        }
        if request.kind == RequestKind::Leave {
            self.close(CloseReason::Left);
            return Ok(());
        }
        let at = now - ServerTime::ZERO;
        if self.accepted.take(1.0, at) {
            self.emit(PeerEvent::Request(request));
            return Ok(());
        }
        if self.refused.take(1.0, at) {
            let refused = RequestRefused {
                id: request.id,
                reason: RequestRefusal::TooMany,
            };
            return self.push(&ServerMessage::RequestRefused(refused), true, now);
        }
        Err(ProtocolError::RequestFlood {
            accepted: REQUESTS_PER_SECOND_MAX,
            refused: REQUESTS_PER_SECOND_MAX,
        })
    }
}
