//! A listening socket: sessions are handed out, model transfers are served here.

use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::{Grant, ModelHash};
use quinn::crypto::rustls::HandshakeData;
use quinn::{Endpoint, Incoming, TokioRuntime, VarInt};
use tokio::sync::{Mutex, Semaphore, mpsc};
use tokio::task::JoinHandle;

use crate::config::{self, ALPN_BULK};
use crate::connection::Connection;
use crate::error::GOODBYE;
use crate::identity::ServerIdentity;
use crate::{TransportError, bulk};

/// Returns the bytes of a model to the holder of a grant; `None` refuses. It must not block.
pub type ModelSource = Arc<dyn Fn(Grant, ModelHash) -> Option<Arc<[u8]>> + Send + Sync>;

/// Handshakes at the same time; more are refused.
const HANDSHAKES_MAX: usize = 256;

/// From this number of pending handshakes on, an address must prove that it is real (QUIC Retry) before
/// the server does any work for it.
const HANDSHAKES_UNVALIDATED_MAX: usize = 16;

/// Sessions that wait for the shell to accept them; further ones wait in their handshake.
const ACCEPTED_MAX: usize = 64;

/// A connection that opens no operations stream within this time is closed.
const OPENING_TIMEOUT: Duration = Duration::from_secs(10);

/// A listening socket. Dropping it ends every connection.
pub struct Server {
    endpoint: Endpoint,
    address: SocketAddr,
    accepted: Mutex<mpsc::Receiver<Connection>>,
    listener: JoinHandle<()>,
}

impl Server {
    /// Listens; to be called inside a tokio runtime. Model transfers are served from `models`.
    pub fn bind(
        address: SocketAddr,
        identity: &ServerIdentity,
        models: ModelSource,
    ) -> Result<Self, TransportError> {
        let config = config::server(identity)?;
        let at_address = |source: std::io::Error| match source.kind() {
            ErrorKind::AddrInUse => TransportError::PortTaken { address },
            _ => TransportError::Bind { address, source },
        };
        let socket = UdpSocket::bind(address).map_err(at_address)?;
        let endpoint = Endpoint::new(
            config::server_endpoint(),
            Some(config),
            socket,
            Arc::new(TokioRuntime),
        )
        .map_err(at_address)?;
        let address = endpoint.local_addr().map_err(at_address)?;
        let (sender, receiver) = mpsc::channel(ACCEPTED_MAX);
        let listener = tokio::spawn(listen(endpoint.clone(), sender, models));
        Ok(Self {
            endpoint,
            address,
            accepted: Mutex::new(receiver),
            listener,
        })
    }

    /// The address of the socket, with the port that was chosen when 0 was asked for.
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// The next client; `None` once closed.
    pub async fn accept(&self) -> Option<Connection> {
        self.accepted.lock().await.recv().await
    }

    /// Closes every connection with a sentence and waits at most two seconds for their acknowledgement.
    pub async fn close(&self, sentence: &str) {
        self.listener.abort();
        self.endpoint
            .close(VarInt::from_u32(GOODBYE), sentence.as_bytes());
        let idle = self.endpoint.wait_idle();
        let _ = tokio::time::timeout(Duration::from_secs(2), idle).await;
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.listener.abort();
        self.endpoint
            .close(VarInt::from_u32(0), b"the server stopped");
    }
}

async fn listen(endpoint: Endpoint, sessions: mpsc::Sender<Connection>, models: ModelSource) {
    let handshakes = Arc::new(Semaphore::new(HANDSHAKES_MAX));
    let transfers = Arc::new(Semaphore::new(bulk::TRANSFERS_MAX));
    while let Some(incoming) = endpoint.accept().await {
        let under_way = HANDSHAKES_MAX - handshakes.available_permits();
        if under_way > HANDSHAKES_UNVALIDATED_MAX && incoming.may_retry() {
            if let Err(error) = incoming.retry() {
                error.into_incoming().refuse();
            }
            continue;
        }
        let Ok(permit) = handshakes.clone().try_acquire_owned() else {
            incoming.refuse();
            continue;
        };
        let sessions = sessions.clone();
        let models = models.clone();
        let transfers = transfers.clone();
        tokio::spawn(async move {
            let address = incoming.remote_address();
            let opened = tokio::time::timeout(OPENING_TIMEOUT, open(incoming)).await;
            drop(permit);
            match opened {
                Ok(Some(Opened::Session(connection))) => {
                    // The shell is gone when this fails, and the endpoint with it.
                    let _ = sessions.send(connection).await;
                }
                Ok(Some(Opened::Bulk(connection, streams))) => {
                    bulk::serve(connection, streams, &models, &transfers).await;
                }
                Ok(None) | Err(_) => tracing::debug!(%address, "an attempt came to nothing"),
            }
        });
    }
}

enum Opened {
    Session(Connection),
    Bulk(quinn::Connection, (quinn::SendStream, quinn::RecvStream)),
}

async fn open(incoming: Incoming) -> Option<Opened> {
    let quic = incoming.await.ok()?;
    let data = quic.handshake_data()?.downcast::<HandshakeData>().ok()?;
    let streams = quic.accept_bi().await.ok()?;
    Some(if data.protocol.as_deref() == Some(ALPN_BULK) {
        Opened::Bulk(quic, streams)
    } else {
        Opened::Session(Connection::new(quic, streams, None))
    })
}
