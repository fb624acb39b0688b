//! Requests of a client: their order, their limits and their rate.

use super::{REQUESTS_PER_SECOND_MAX, ServerPeer};
use crate::codec;
use crate::request::{
    ClientMessage, Request, RequestKind, RequestRefusal, RequestRefused, ServerMessage,
};
use crate::session::{CloseReason, PeerEvent};
use crate::{ProtocolError, ServerTime};

impl ServerPeer {
    /// A copy of a message of the stream.
    pub(super) fn handle_copy(
        &mut self,
        message: &[u8],
        now: ServerTime,
    ) -> Result<(), ProtocolError> {
        let ClientMessage::Request(request) = codec::decode_body(message)? else {
            return Err(ProtocolError::OutOfOrder {
                what: "copy of a message",
                state: "only requests have copies",
            });
        };
        self.requests.push(request.id.0.into(), request);
        self.handle_early(now)
    }

    /// The copies without a gap before them.
    pub(super) fn handle_early(&mut self, now: ServerTime) -> Result<(), ProtocolError> {
        while let Some(request) = self.requests.pop() {
            self.handle_request(request, now)?;
        }
        Ok(())
    }

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
            return self.outbox.push(&ServerMessage::RequestRefused(refused));
        }
        Err(ProtocolError::RequestFlood {
            accepted: REQUESTS_PER_SECOND_MAX,
            refused: REQUESTS_PER_SECOND_MAX,
        })
    }
}
