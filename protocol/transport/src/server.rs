//! A listening socket: sessions are handed out, model transfers are served here.

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
use crate::config::{self, ALPN_BULK};
use crate::connection::Connection;
use crate::error::GOODBYE;
use crate::identity::ServerIdentity;
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
        let slots = Slots::new();
        let listener = Listener {
            endpoint: endpoint.clone(),
            slots: Arc::clone(&slots),
            sessions: sender,
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

    /// Completes the handshake and serves a transfer, or hands a session to the shell.
    async fn serve(self, incoming: Incoming, mut slot: Slot) {
        let address = incoming.remote_address();
        let Some((quic, streams)) = open(incoming, &mut slot).await else {
            tracing::debug!(%address, "an attempt came to nothing");
            return;
        };
        if is_bulk(&quic) {
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
}

type Streams = (quinn::SendStream, quinn::RecvStream);

async fn open(incoming: Incoming, slot: &mut Slot) -> Option<(quinn::Connection, Streams)> {
    let quic = slot.shake(incoming).await?;
    // The slot closes a connection that opens no stream.
    let streams = quic.accept_bi().await.ok()?;
    Some((quic, streams))
}

fn is_bulk(quic: &quinn::Connection) -> bool {
    let data = quic.handshake_data().and_then(|data| data.downcast().ok());
    data.is_some_and(|data: Box<HandshakeData>| data.protocol.as_deref() == Some(ALPN_BULK))
}
