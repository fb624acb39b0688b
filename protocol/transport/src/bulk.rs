//! Model transfer, on its own connection so that it never blocks a datagram.
//!
//! ```text
//! client -> server   grant 16 B | model hash u64 LE
//! server -> client   0 | length u64 LE | the bytes          or 1 to refuse
//! ```

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::link::GRANT_BYTES;
use palpate_protocol::{Grant, JoinLink, ModelHash};
use quinn::{RecvStream, SendStream, VarInt};
use tokio::sync::Semaphore;

use crate::TransportError;
use crate::client::reach;
use crate::config::ALPN_BULK;
use crate::server::ModelSource;

/// The largest model that a client accepts, bytes; a larger one is refused before it is sent.
pub const MODEL_MAX_BYTES: u64 = 512 * 1024 * 1024;

/// Transfers at the same time; further ones wait.
pub(crate) const TRANSFERS_MAX: usize = 16;

/// The longest time for a whole transfer; then it is aborted.
const TRANSFER_TIMEOUT: Duration = Duration::from_secs(600);

const REQUEST_BYTES: usize = GRANT_BYTES + 8;
const GIVEN: u8 = 0;
const REFUSED: u8 = 1;
const PIECE: usize = 64 * 1024;

/// Fetches a model; `progress(done, total)` in bytes. The caller compares the hash.
pub async fn fetch_model(
    link: &JoinLink,
    hash: ModelHash,
    mut progress: impl FnMut(u64, u64) + Send,
) -> Result<Vec<u8>, TransportError> {
    let (endpoint, quic) = reach(link, ALPN_BULK).await?;
    let address = quic.remote_address();
    let lost = |detail: String| TransportError::Lost { address, detail };
    let (mut send, mut recv) = quic.open_bi().await.map_err(|e| lost(e.to_string()))?;
    let mut request = [0; REQUEST_BYTES];
    request[..GRANT_BYTES].copy_from_slice(&link.grant.0);
    request[GRANT_BYTES..].copy_from_slice(&hash.0.to_le_bytes());
    send.write_all(&request)
        .await
        .map_err(|e| lost(e.to_string()))?;
    send.finish().map_err(|e| lost(e.to_string()))?;

    let mut status = [0];
    recv.read_exact(&mut status)
        .await
        .map_err(|e| lost(e.to_string()))?;
    if status[0] != GIVEN {
        return Err(TransportError::ModelRefused { hash });
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

/// Serves one transfer, to its end or to the timeout.
pub(crate) async fn serve(
    quic: quinn::Connection,
    (send, recv): (SendStream, RecvStream),
    models: &ModelSource,
    transfers: &Arc<Semaphore>,
) {
    let work = async {
        // Never closed, therefore never an error.
        let _permit = transfers.acquire().await.ok()?;
        give(send, recv, models).await
    };
    if tokio::time::timeout(TRANSFER_TIMEOUT, work)
        .await
        .ok()
        .flatten()
        .is_none()
    {
        tracing::debug!(address = %quic.remote_address(), "a model transfer was not finished");
    }
    quic.close(VarInt::from_u32(0), b"done");
}

async fn give(mut send: SendStream, mut recv: RecvStream, models: &ModelSource) -> Option<()> {
    let mut request = [0; REQUEST_BYTES];
    recv.read_exact(&mut request).await.ok()?;
    let (grant, hash) = request.split_first_chunk::<GRANT_BYTES>()?;
    let hash = ModelHash(u64::from_le_bytes(hash.try_into().ok()?));
    match models(Grant(*grant), hash) {
        None => send.write_all(&[REFUSED]).await.ok()?,
        Some(bytes) => {
            send.write_all(&[GIVEN]).await.ok()?;
            send.write_all(&(bytes.len() as u64).to_le_bytes())
                .await
                .ok()?;
            for piece in bytes.chunks(PIECE) {
                send.write_all(piece).await.ok()?;
            }
        }
    }
    send.finish().ok()?;
    send.stopped().await.ok()?;
    Some(())
}
