//! A server, and clients that join its sessions, over real quinn on this host.

// Each suite needs a part of it.
#![allow(dead_code)]

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_protocol::handshake::{Hello, Subscription, Welcome};
use palpate_protocol::operation::{
    CompensationMode, CompensationSettings, Operation, OperationKind,
};
use palpate_protocol::session::{ClientEvent, ClientSession, PeerEvent, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, Epoch, Grant, JoinLink, ModelHash, ModelInfo, OperationId, ParticipantId,
    ResumeToken, Role, ServerTime, TopologyHash,
};
use palpate_transport::{
    ClientHandle, ModelRequest, ModelSource, PeerHandle, PeerId, PeerInput, Server, ServerIdentity,
    connect, spawn_client, spawn_peer,
};
use quinn::crypto::rustls::QuicClientConfig;
use quinn::{Connection, Endpoint};
use tokio::sync::mpsc;

pub(crate) const ANY_PORT: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
pub(crate) const GRANT: Grant = Grant([9; 16]);
pub(crate) const MODEL: ModelHash = ModelHash(77);
/// The seat that may fetch the model.
pub(crate) const SEAT: ParticipantId = ParticipantId(1);
pub(crate) const TOKEN: ResumeToken = ResumeToken([4; 16]);
pub(crate) const REQUEST: ModelRequest = ModelRequest {
    participant: SEAT,
    token: TOKEN,
    hash: MODEL,
};
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// A server with a model, and the link to it.
pub(crate) fn serve() -> (Server, JoinLink) {
    let (server, link, _) = serve_as();
    (server, link)
}

/// The same, with its identity.
pub(crate) fn serve_as() -> (Server, JoinLink, ServerIdentity) {
    let identity = ServerIdentity::generate().unwrap();
    let model: Arc<[u8]> = vec![0xab; 3_000_000].into();
    let models: ModelSource = Arc::new(move |participant, token, hash| {
        let has_seat = participant == SEAT && token.matches(&TOKEN);
        (has_seat && hash == MODEL).then(|| Arc::clone(&model))
    });
    let server = Server::bind(ANY_PORT, &identity, models).unwrap();
    let link = JoinLink {
        host: "127.0.0.1".to_owned(),
        port: server.local_addr().port(),
        role: Role::Trainee,
        certificate: identity.certificate_hash(),
        grant: GRANT,
    };
    (server, link, identity)
}

pub(crate) fn hello(name: &str) -> Hello {
    Hello {
        name: name.to_owned(),
        role: Role::Trainee,
        grant: GRANT,
        tool: Some(ToolDescription::probe(0.004)),
        subscription: Subscription::Full,
        resume: None,
    }
}

pub(crate) fn welcome(participant: u16, operations_so_far: u64) -> PeerMessage {
    PeerMessage::Welcome(Box::new(Welcome {
        participant: ParticipantId(participant),
        epoch: Epoch(1),
        role: Role::Trainee,
        server_time: ServerTime::ZERO,
        model: ModelInfo {
            hash: MODEL,
            bytes: 3_000_000,
        },
        roster: Vec::new(),
        topology_version: 0,
        topology_hash: TopologyHash(1),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far,
        compensation: CompensationSettings {
            mode: CompensationMode::None,
            initial_delay_us: 0,
        },
        tick_hz: 250,
        session_started_at: None,
        resume_token: TOKEN,
    }))
}

pub(crate) fn operation(id: u64) -> PeerMessage {
    PeerMessage::Operation(Arc::new(Operation {
        id: OperationId(id),
        at: ServerTime::ZERO,
        author: ParticipantId::SERVER,
        topology_version_before: 0,
        topology_version_after: 0,
        hash_after: TopologyHash(1),
        kind: OperationKind::Started {
            at: ServerTime::ZERO,
        },
    }))
}

pub(crate) fn client_clock(since: Instant) -> impl Fn() -> ClientTime + Send + Clone + 'static {
    move || ClientTime::from_micros(since.elapsed().as_micros() as i64)
}

pub(crate) fn server_clock(since: Instant) -> impl Fn() -> ServerTime + Send + Clone + 'static {
    move || ServerTime::from_micros(since.elapsed().as_micros() as i64 + 5_000_000)
}

pub(crate) async fn join(link: &JoinLink, name: &str, since: Instant) -> ClientHandle {
    let clock = client_clock(since);
    let session = ClientSession::new(hello(name), clock()).unwrap();
    spawn_client(connect(link).await.unwrap(), session, clock)
}

pub(crate) async fn next_event(client: &mut ClientHandle) -> ClientEvent {
    tokio::time::timeout(PATIENCE, client.events.recv())
        .await
        .unwrap()
        .unwrap()
}

pub(crate) async fn next_input(inbox: &mut mpsc::Receiver<PeerInput>) -> PeerInput {
    tokio::time::timeout(PATIENCE, inbox.recv())
        .await
        .unwrap()
        .unwrap()
}

/// One client in, with a hello answered.
pub(crate) async fn admit(
    server: &Server,
    link: &JoinLink,
    n: u16,
    inbox: &(mpsc::Sender<PeerInput>, Instant),
    receiver: &mut mpsc::Receiver<PeerInput>,
) -> (PeerHandle, ClientHandle) {
    let client = join(link, &format!("client {n}"), inbox.1).await;
    let connection = server.accept().await.unwrap();
    let peer = spawn_peer(
        connection,
        PeerId(n.into()),
        server_clock(inbox.1),
        inbox.0.clone(),
    );
    loop {
        let input = next_input(receiver).await;
        if input.peer == PeerId(n.into()) && matches!(input.event, PeerEvent::Hello(_)) {
            break;
        }
    }
    assert!(peer.send(welcome(n, 3)));
    (peer, client)
}

/// A connection like a client's, without the project's session handling and without the cap on its
/// sending rate.
pub(crate) async fn unbound(server: &Server, identity: &ServerIdentity) -> (Endpoint, Connection) {
    unbound_as(server, identity, SESSION).await
}

pub(crate) const SESSION: &[u8] = b"palpate/1";
pub(crate) const BULK: &[u8] = b"palpate-bulk/1";

/// The same for a session or a transfer.
pub(crate) async fn unbound_as(
    server: &Server,
    identity: &ServerIdentity,
    alpn: &[u8],
) -> (Endpoint, Connection) {
    let endpoint = Endpoint::client(ANY_PORT).unwrap();
    let connection = endpoint
        .connect_with(
            client_config(identity, alpn),
            server.local_addr(),
            "palpate",
        )
        .unwrap()
        .await
        .unwrap();
    (endpoint, connection)
}

/// quinn's own settings of a client.
pub(crate) fn client_config(identity: &ServerIdentity, alpn: &[u8]) -> quinn::ClientConfig {
    let mut roots = rustls::RootCertStore::empty();
    roots.add(identity.to_der().0.into()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut tls = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    tls.alpn_protocols = vec![alpn.to_vec()];
    quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()))
}

/// A client's first bytes: enough to be admitted.
pub(crate) fn opening(name: &str) -> Vec<u8> {
    let mut session = ClientSession::new(hello(name), ClientTime::ZERO).unwrap();
    std::iter::from_fn(|| session.poll_stream())
        .flatten()
        .collect()
}
