//! Model transfer, on its own connection so that it never blocks a datagram.
//!
//! ```text
//! client -> server   participant u16 LE | resume token 16 B | model hash u64 LE
//! server -> client   0 | length u64 LE | the bytes          or 1 to refuse
//! ```
//!
//! Only a participant of the session gets the model, and has one transfer at a time. Until its request is
//! complete and accepted, the connection is pending ([`crate::slots`]) and may be closed for a newer one.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use palpate_protocol::handshake::Welcome;
use palpate_protocol::link::TOKEN_BYTES;
use palpate_protocol::{JoinLink, ModelHash, ParticipantId, ResumeToken};
use quinn::{RecvStream, SendStream, VarInt};

use crate::TransportError;
use crate::client::reach;
use crate::config::{ALPN_BULK, BULK_SEND_WINDOW};
use crate::slots::Slot;

/// The largest model that a client accepts, bytes; a larger one is refused before it is sent.
pub const MODEL_MAX_BYTES: u64 = 512 * 1024 * 1024;

/// The longest time for a whole transfer; then it is aborted.
const TRANSFER_TIMEOUT: Duration = Duration::from_secs(600);

/// How often the server checks that the receiver still has its seat; otherwise the transfer is aborted.
/// It bounds the transfers by the seats of the session.
const SEAT_CHECK: Duration = Duration::from_secs(2);

const REQUEST_BYTES: usize = 2 + TOKEN_BYTES + 8;
const GIVEN: u8 = 0;
const REFUSED: u8 = 1;
const PIECE: usize = 64 * 1024;

/// Returns the bytes of a model to a participant with its resume token; `None` refuses. It must not block.
pub type ModelSource =
    Arc<dyn Fn(ParticipantId, ResumeToken, ModelHash) -> Option<Arc<[u8]>> + Send + Sync>;

/// A participant's request for the model of its session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ModelRequest {
    /// The participant.
    pub participant: ParticipantId,
    /// The proof that it is this participant.
    pub token: ResumeToken,
    /// The model.
    pub hash: ModelHash,
}

impl ModelRequest {
    /// The request of a welcomed participant.
    pub fn of(welcome: &Welcome) -> Self {
        Self {
            participant: welcome.participant,
            token: welcome.resume_token,
            hash: welcome.model.hash,
        }
    }

    fn to_bytes(self) -> [u8; REQUEST_BYTES] {
        let mut bytes = [0; REQUEST_BYTES];
        bytes[..2].copy_from_slice(&self.participant.0.to_le_bytes());
        bytes[2..2 + TOKEN_BYTES].copy_from_slice(&self.token.0);
        bytes[2 + TOKEN_BYTES..].copy_from_slice(&self.hash.0.to_le_bytes());
        bytes
    }

    fn from_bytes(bytes: &[u8; REQUEST_BYTES]) -> Option<Self> {
        let (participant, rest) = bytes.split_first_chunk()?;
        let (token, rest) = rest.split_first_chunk()?;
        Some(Self {
            participant: ParticipantId(u16::from_le_bytes(*participant)),
            token: ResumeToken(*token),
            hash: ModelHash(u64::from_le_bytes(*rest.first_chunk()?)),
        })
    }
}

/// Fetches a model; `progress(done, total)` in bytes. The caller compares the hash.
pub async fn fetch_model(
    link: &JoinLink,
    request: ModelRequest,
    mut progress: impl FnMut(u64, u64) + Send,
) -> Result<Vec<u8>, TransportError> {
    let (endpoint, quic) = reach(link, ALPN_BULK).await?;
    let address = quic.remote_address();
    let lost = |detail: String| TransportError::Lost { address, detail };
    let (mut send, mut recv) = quic.open_bi().await.map_err(|e| lost(e.to_string()))?;
    send.write_all(&request.to_bytes())
        .await
        .map_err(|e| lost(e.to_string()))?;
    send.finish().map_err(|e| lost(e.to_string()))?;

    let mut status = [0];
    recv.read_exact(&mut status)
        .await
        .map_err(|e| lost(e.to_string()))?;
    if status[0] != GIVEN {
        return Err(TransportError::ModelRefused { hash: request.hash });
    }
    let mut length = [0; 8];
    recv.read_exact(&mut length)
        .await
        .map_err(|e| lost(e.to_string()))?;
    let total = u64::from_le_bytes(length);
    if total > MODEL_MAX_BYTES {
        return Err(TransportError::ModelTooLarge {
            bytes: total,
            limit: MODEL_MAX_BYTES,
        });
    }
    // The buffer grows with the received bytes, not with the announced length.
    let mut bytes = Vec::new();
    while let Some(chunk) = recv
        .read_chunk(PIECE, true)
        .await
        .map_err(|e| lost(e.to_string()))?
    {
        bytes.extend_from_slice(&chunk.bytes);
        if bytes.len() as u64 > total {
            return Err(lost(
                "more bytes of the model arrived than were announced".to_owned(),
            ));
        }
        progress(bytes.len() as u64, total);
    }
    if bytes.len() as u64 != total {
        return Err(lost(format!(
            "only {} of {total} bytes of the model arrived",
            bytes.len()
        )));
    }
    quic.close(VarInt::from_u32(0), b"done");
    let _ = tokio::time::timeout(Duration::from_millis(500), endpoint.wait_idle()).await;
    Ok(bytes)
}

/// The transfers of a server: at most one per participant.
#[derive(Default)]
pub(crate) struct Transfers {
    running: Mutex<HashMap<ParticipantId, quinn::Connection>>,
}

impl Transfers {
    fn lock(&self) -> MutexGuard<'_, HashMap<ParticipantId, quinn::Connection>> {
        // Every statement leaves the map consistent.
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes a transfer, and ends an older one of the same participant: its connection may be dead.
    fn begin(&self, participant: ParticipantId, quic: &quinn::Connection) {
        let older = self.lock().insert(participant, quic.clone());
        if let Some(older) = older {
            older.close(VarInt::from_u32(0), b"a newer transfer replaced this one");
        }
    }

    fn end(&self, participant: ParticipantId, quic: &quinn::Connection) {
        let mut running = self.lock();
        let is_this = |newest: &quinn::Connection| newest.stable_id() == quic.stable_id();
        if running.get(&participant).is_some_and(is_this) {
            running.remove(&participant);
        }
    }
}

/// Serves one transfer, to its end or to the timeout.
pub(crate) async fn serve(
    quic: quinn::Connection,
    (mut send, recv): (SendStream, RecvStream),
    slot: Slot,
    models: &ModelSource,
    transfers: &Transfers,
) {
    // The slot closes the connection of a request that takes too long.
    let Some(request) = read_request(recv).await else {
        return;
    };
    let has_seat = || models(request.participant, request.token, request.hash);
    let Some(bytes) = has_seat() else {
        slot.count_refused_transfer();
        refuse(send).await;
        return;
    };
    drop(slot);
    quic.set_send_window(BULK_SEND_WINDOW);
    transfers.begin(request.participant, &quic);
    let seat_is_lost = async {
        while has_seat().is_some() {
            tokio::time::sleep(SEAT_CHECK).await;
        }
    };
    let work = async {
        tokio::select! {
            given = give(&mut send, &bytes) => given,
            () = seat_is_lost => None,
        }
    };
    let given = tokio::time::timeout(TRANSFER_TIMEOUT, work).await;
    if given.ok().flatten().is_none() {
        tracing::debug!(address = %quic.remote_address(), "a model transfer was not finished");
    }
    quic.close(VarInt::from_u32(0), b"done");
    transfers.end(request.participant, &quic);
}

async fn read_request(mut recv: RecvStream) -> Option<ModelRequest> {
    let mut request = [0; REQUEST_BYTES];
    recv.read_exact(&mut request).await.ok()?;
    ModelRequest::from_bytes(&request)
}

/// Ends when the other side has the refusal, or with the slot.
async fn refuse(mut send: SendStream) {
    if send.write_all(&[REFUSED]).await.is_ok() && send.finish().is_ok() {
        let _ = send.stopped().await;
    }
}

async fn give(send: &mut SendStream, bytes: &[u8]) -> Option<()> {
    send.write_all(&[GIVEN]).await.ok()?;
    let length = (bytes.len() as u64).to_le_bytes();
    send.write_all(&length).await.ok()?;
    for piece in bytes.chunks(PIECE) {
        send.write_all(piece).await.ok()?;
    }
    send.finish().ok()?;
    send.stopped().await.ok()?;
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn request_is_read_as_written_and_as_specified() {
        let request = ModelRequest {
            participant: ParticipantId(0x0201),
            token: ResumeToken([7; TOKEN_BYTES]),
            hash: ModelHash(0x0807_0605_0403_0201),
        };
        let bytes = request.to_bytes();
        assert_eq!(ModelRequest::from_bytes(&bytes), Some(request));
        assert_eq!(bytes[..3], [1, 2, 7]);
        assert_eq!(bytes[17..], [7, 1, 2, 3, 4, 5, 6, 7, 8]);
    }
}
