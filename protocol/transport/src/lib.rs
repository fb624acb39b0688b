//! Drives a protocol session over quinn and tokio.
//!
//! This crate never decides anything about tissue, and it alone names quinn. A shell gives it a
//! clock and channels:
//!
//! ```text
//! client   connect(&link) -> Connection;   spawn_client(connection, session, clock) -> ClientHandle
//! server   Server::bind -> accept() -> Connection;   spawn_peer(connection, id, clock, inbox) -> PeerHandle
//! model    fetch_model(&link, hash, progress) on a connection of its own
//! ```

use std::net::SocketAddr;
use std::sync::Arc;

use palpate_protocol::request::RequestKind;
use palpate_protocol::session::{
    ClientEvent, ClientSession, LinkStats, PeerDatagram, PeerEvent, PeerMessage,
};
use palpate_protocol::{
    CertificateHash, ClientTime, Grant, JoinLink, LocalSample, ModelHash, ServerTime,
};
use tokio::sync::{mpsc, watch};

/// What can go wrong between two hosts.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// The address can not be listened on.
    #[error("can not listen on {address}: {source}")]
    Bind {
        /// The address.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
}

/// A self-signed certificate and its key.
pub struct ServerIdentity {}

impl ServerIdentity {
    /// A new one.
    pub fn generate() -> Result<Self, TransportError> {
        unimplemented!()
    }
    /// For the join link.
    pub fn certificate_hash(&self) -> CertificateHash {
        unimplemented!()
    }
}

/// Gives the bytes of a model to who holds a grant; `None` refuses.
pub type ModelSource = Arc<dyn Fn(Grant, ModelHash) -> Option<Arc<[u8]>> + Send + Sync>;

/// A listening socket.
pub struct Server {}

#[expect(unused_variables, clippy::unused_async, reason = "bodies follow")]
impl Server {
    /// Listens; inside a tokio runtime. Model transfers are served from `models` by itself.
    pub fn bind(
        address: SocketAddr,
        identity: &ServerIdentity,
        models: ModelSource,
    ) -> Result<Self, TransportError> {
        unimplemented!()
    }
    /// Where it listens (with the port chosen, when 0 was asked for).
    pub fn local_addr(&self) -> SocketAddr {
        unimplemented!()
    }
    /// The next client; `None` once closed.
    pub async fn accept(&self) -> Option<Connection> {
        unimplemented!()
    }
    /// Closes every connection and waits until they know.
    pub async fn close(&self, sentence: &str) {}
}

/// A connection with its operations stream.
pub struct Connection {}

/// Connects to the server of a join link.
#[expect(clippy::unused_async, unused_variables, reason = "bodies follow")]
pub async fn connect(link: &JoinLink) -> Result<Connection, TransportError> {
    unimplemented!()
}

/// Fetches a model on a connection of its own; `progress(done, total)` in bytes.
#[expect(clippy::unused_async, unused_variables, reason = "bodies follow")]
pub async fn fetch_model(
    link: &JoinLink,
    hash: ModelHash,
    progress: impl FnMut(u64, u64) + Send,
) -> Result<Vec<u8>, TransportError> {
    unimplemented!()
}

/// What the shell tells the task that drives a client session.
#[derive(Debug)]
pub enum ClientCommand {
    /// New samples of one's own tool, oldest first. Send them every 4 ms.
    Motion(Vec<LocalSample>),
    /// Ask for something.
    Request(RequestKind),
    /// Leave politely.
    Leave,
}

/// A client session that runs in a task.
pub struct ClientHandle {
    /// Bounded; use `try_send` from a real-time neighbour and drop on overflow.
    pub commands: mpsc::Sender<ClientCommand>,
    /// Bounded; the last event is `Closed`.
    pub events: mpsc::Receiver<ClientEvent>,
    /// Newest figures, some ten times a second.
    pub stats: watch::Receiver<LinkStats>,
}

/// Drives a client session in a task of its own. `clock` is the client's monotonic clock.
#[expect(
    unused_variables,
    clippy::needless_pass_by_value,
    reason = "bodies follow"
)]
pub fn spawn_client(
    connection: Connection,
    session: ClientSession,
    clock: impl Fn() -> ClientTime + Send + 'static,
) -> ClientHandle {
    unimplemented!()
}

/// One connection of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerId(pub u64);

/// Something from one peer, for the one task that owns the room.
#[derive(Debug)]
pub struct PeerInput {
    /// From whom.
    pub peer: PeerId,
    /// When it arrived.
    pub at: ServerTime,
    /// What.
    pub event: PeerEvent,
}

/// The room's end of one peer. All of it is non-blocking.
pub struct PeerHandle {
    /// Whom it reaches.
    pub id: PeerId,
}

#[expect(unused_variables, reason = "bodies follow")]
impl PeerHandle {
    /// Something reliable; `false` when the peer is gone or too slow, in which case it is closed
    /// and a `Closed` input follows.
    pub fn send(&self, message: PeerMessage) -> bool {
        false
    }
    /// Something that may get lost; `false` when it was dropped, which is counted.
    pub fn send_datagram(&self, datagram: PeerDatagram) -> bool {
        false
    }
    /// Newest figures.
    pub fn stats(&self) -> LinkStats {
        LinkStats::default()
    }
}

/// Drives one peer in a task of its own; what it learns goes into the one bounded `inbox` of all
/// peers.
#[expect(
    unused_variables,
    clippy::needless_pass_by_value,
    reason = "bodies follow"
)]
pub fn spawn_peer(
    connection: Connection,
    id: PeerId,
    clock: impl Fn() -> ServerTime + Send + 'static,
    inbox: mpsc::Sender<PeerInput>,
) -> PeerHandle {
    unimplemented!()
}
