//! A listening socket: sessions and browsers are handed out, model transfers are served here.

use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use quinn::crypto::rustls::HandshakeData;
use quinn::{Endpoint, Incoming, TokioRuntime, VarInt};
use tokio::sync::{Mutex, mpsc};
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;

use crate::admission::AdmissionStats;
use crate::bulk::{ModelSource, Transfers};
use crate::certificate::ShortLived;
use crate::config::{self, ALPN_BULK, ALPN_PAGE};
use crate::connection::Connection;
use crate::error::GOODBYE;
use crate::identity::ServerIdentity;
use crate::page_connection::{PageAttempt, PageDoor};
use crate::slots::{Attempt, CHECK_PERIOD, Slot, Slots};
use crate::{TransportError, bulk};

/// Sessions that wait for the shell to accept them; further ones wait in their slots.
const ACCEPTED_MAX: usize = 64;

/// A listening socket. Dropping it ends every connection.
pub struct Server {
    endpoint: Endpoint,
    address: SocketAddr,
    accepted: Mutex<mpsc::Receiver<Connection>>,
    slots: Arc<Slots>,
    listener: JoinHandle<()>,
}

impl Server {
    /// Listens; to be called inside a tokio runtime. Model transfers are served from `models`.
    pub fn bind(
        address: SocketAddr,
        identity: &ServerIdentity,
        models: ModelSource,
    ) -> Result<Self, TransportError> {
        Self::listen(address, (identity, None), models, None)
    }

    /// The same, and serves browsers by WebTransport, with a certificate of short validity for the host names or
    /// addresses `names`.
    pub fn bind_with_pages(
        address: SocketAddr,
        identity: &ServerIdentity,
        models: ModelSource,
        names: Vec<String>,
    ) -> Result<(Self, PageDoor), TransportError> {
        let certificate = ShortLived::new(names)?;
        let (sender, attempts) = mpsc::channel(ACCEPTED_MAX);
        let identities = (identity, Some(Arc::clone(&certificate)));
        let server = Self::listen(address, identities, models, Some(sender))?;
        let door = PageDoor::new(server.address.port(), certificate, attempts);
        Ok((server, door))
    }

    fn listen(
        address: SocketAddr,
        (identity, page): (&ServerIdentity, Option<Arc<ShortLived>>),
        models: ModelSource,
        pages: Option<mpsc::Sender<PageAttempt>>,
    ) -> Result<Self, TransportError> {
        let config = config::server(identity, page)?;
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
        let slots = Slots::new();
        let listener = Listener {
            endpoint: endpoint.clone(),
            slots: Arc::clone(&slots),
            sessions: sender,
            pages,
            models,
            transfers: Arc::default(),
        };
        let listener = tokio::spawn(listener.listen());
        Ok(Self {
            endpoint,
            address,
            accepted: Mutex::new(receiver),
            slots,
            listener,
        })
    }

    /// The address of the socket, with the port that was chosen when 0 was asked for.
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Counters of the connections that were not admitted.
    pub fn admission(&self) -> AdmissionStats {
        self.slots.stats()
    }

    /// The next client, with the first byte of its stream; `None` once closed. The connection is pending
    /// until [`spawn_peer`](crate::spawn_peer) welcomes it or [`Connection::admit`] is called: it is closed
    /// without a hello 2 s after its handshake, or when newer ones need its place.
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

/// The task that answers attempts to connect.
#[derive(Clone)]
struct Listener {
    endpoint: Endpoint,
    slots: Arc<Slots>,
    sessions: mpsc::Sender<Connection>,
    /// Without it, no browser is served.
    pages: Option<mpsc::Sender<PageAttempt>>,
    models: ModelSource,
    transfers: Arc<Transfers>,
}

impl Listener {
    async fn listen(self) {
        let mut check = tokio::time::interval(CHECK_PERIOD);
        check.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            let incoming = tokio::select! {
                incoming = self.endpoint.accept() => incoming,
                _ = check.tick() => {
                    self.slots.close_overdue();
                    continue;
                }
            };
            let Some(incoming) = incoming else {
                return;
            };
            let from = incoming.remote_address().ip();
            match self
                .slots
                .attempt(from, incoming.remote_address_validated())
            {
                Attempt::Ignore => incoming.ignore(),
                Attempt::Retry => {
                    // quinn allows it for every address that is not validated.
                    if let Err(error) = incoming.retry() {
                        error.into_incoming().ignore();
                    }
                }
                Attempt::Admitted(slot) => {
                    tokio::spawn(self.clone().serve(incoming, slot));
                }
            }
        }
    }

    /// Completes the handshake and serves a transfer, or hands a session or a browser to the shell.
    async fn serve(self, incoming: Incoming, mut slot: Slot) {
        let address = incoming.remote_address();
        let Some(quic) = slot.shake(incoming).await else {
            tracing::debug!(%address, "an attempt came to nothing");
            return;
        };
        let alpn = alpn(&quic);
        if alpn.as_deref() == Some(ALPN_PAGE) {
            self.serve_page(quic, slot).await;
            return;
        }
        // The slot closes a connection that opens no stream.
        let Ok(streams) = quic.accept_bi().await else {
            tracing::debug!(%address, "an attempt came to nothing");
            return;
        };
        if alpn.as_deref() == Some(ALPN_BULK) {
            bulk::serve(quic, streams, slot, &self.models, &self.transfers).await;
            return;
        }
        let connection = Connection::pending(quic.clone(), streams, slot);
        tokio::select! {
            // The shell is gone when this fails, and the endpoint with it.
            _ = self.sessions.send(connection) => {}
            _ = quic.closed() => {}
        }
    }

    async fn serve_page(self, quic: quinn::Connection, slot: Slot) {
        let address = quic.remote_address();
        let attempt = PageAttempt::receive(quic.clone(), slot).await;
        let (Some(pages), Some(attempt)) = (self.pages, attempt) else {
            tracing::debug!(%address, "no WebTransport request");
            quic.close(VarInt::from_u32(0), b"only WebTransport is served here");
            return;
        };
        tokio::select! {
            _ = pages.send(attempt) => {}
            _ = quic.closed() => {}
        }
    }
}

fn alpn(quic: &quinn::Connection) -> Option<Vec<u8>> {
    let data = quic.handshake_data()?.downcast::<HandshakeData>().ok()?;
    data.protocol
}
