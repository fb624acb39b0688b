//! Attacks on a server over real sockets: each costs it a bounded amount and keeps no participant out.
//!
//! Time appears only in the bound on the number that a rate passes.
#![allow(clippy::unwrap_used)]
#![cfg_attr(not(target_os = "linux"), allow(dead_code, unused_imports))]

#[path = "support/session.rs"]
mod session;

use std::collections::HashSet;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use palpate_protocol::codec::FRAME_MAX_BYTES;
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::{DelayReport, Request, RequestKind, RequestRefusal};
use palpate_protocol::session::{
    ClientEvent, ClientSession, CloseReason, OUTBOX_HIGH_WATER_BYTES, PeerDatagram, PeerEvent,
    PeerMessage, REFUSALS_BURST_MAX, REQUESTS_BURST_MAX, REQUESTS_PER_SECOND_MAX,
};
use palpate_protocol::{
    ClientTime, OperationId, ParticipantId, ProtocolError, RequestId, Role, TopologyHash,
};
use palpate_transport::{
    ModelRequest, PeerHandle, PeerId, PeerInput, Server, ServerIdentity, TransportError,
    fetch_model, spawn_peer,
};
use quinn::{Connection, Endpoint, RecvStream, SendStream};
use quinn_proto::DatagramEvent;
use session::{
    BULK, PATIENCE, REQUEST, admit, client_clock, client_config, hello, next_event, next_input,
    operation, serve_as, server_clock, unbound, unbound_as, welcome,
};
use tokio::sync::mpsc;

/// Half-open handshakes from one socket, as fast as the server answers with proofs of the address.
struct HalfOpen {
    socket: UdpSocket,
    endpoint: quinn_proto::Endpoint,
    config: quinn::ClientConfig,
    server: SocketAddr,
}

impl HalfOpen {
    /// At another address than all honest clients: the whole of 127.0.0.0/8 is this host.
    fn new(server: SocketAddr, identity: &ServerIdentity) -> Self {
        let socket = UdpSocket::bind("127.0.0.2:0").unwrap();
        socket
            .set_read_timeout(Some(Duration::from_millis(20)))
            .unwrap();
        Self {
            socket,
            endpoint: quinn_proto::Endpoint::new(Arc::default(), None, false, None),
            config: client_config(identity, session::SESSION),
            server,
        }
    }

    /// Sends a first packet, proves the address if asked, and then goes silent.
    fn attempt(&mut self) {
        let now = Instant::now();
        let connected = self
            .endpoint
            .connect(now, self.config.clone(), self.server, "palpate");
        let (handle, mut connection) = connected.unwrap();
        self.send(&mut connection);
        let mut buffer = [0; 2048];
        while let Ok(n) = self.socket.recv(&mut buffer) {
            // Only a Retry is of use; late answers to earlier attempts are thrown away.
            if buffer[0] & 0xf0 != 0xf0 {
                continue;
            }
            let bytes = buffer[..n].into();
            let mut answer = Vec::new();
            let event = self
                .endpoint
                .handle(now, self.server, None, None, bytes, &mut answer);
            if let Some(DatagramEvent::ConnectionEvent(to, event)) = event
                && to == handle
            {
                connection.handle_event(event);
                self.send(&mut connection);
                return;
            }
        }
    }

    fn send(&self, connection: &mut quinn_proto::Connection) {
        let mut packet = Vec::new();
        while let Some(transmit) = connection.poll_transmit(Instant::now(), 1, &mut packet) {
            self.socket
                .send_to(&packet[..transmit.size], self.server)
                .unwrap();
            packet.clear();
        }
    }
}

/// Needs more than one loopback address.
#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn newcomers_join_while_one_address_opens_handshakes_without_end() {
    let (server, link, identity) = serve_as();
    let mut flood = HalfOpen::new(server.local_addr(), &identity);
    let ends = Arc::new(AtomicBool::new(false));
    let ended = Arc::clone(&ends);
    let flooding = std::thread::spawn(move || {
        while !ended.load(Ordering::Relaxed) {
            flood.attempt();
        }
    });
    let full = async {
        while server.admission().evicted == 0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(PATIENCE, full).await.unwrap();
    let (sender, mut receiver) = mpsc::channel(1024);
    let inbox = (sender, Instant::now());
    for n in 1..=10 {
        let (_peer, mut client) = admit(&server, &link, n, &inbox, &mut receiver).await;
        let event = next_event(&mut client).await;
        assert!(matches!(event, ClientEvent::Welcomed(_)), "{event:?}");
    }
    ends.store(true, Ordering::Relaxed);
    flooding.join().unwrap();
    let stats = server.admission();
    assert!(stats.retried > 0 && stats.evicted > 0, "{stats:?}");
}

/// A transfer's connection that sends some bytes; the stream must stay alive with it.
async fn transfer(
    server: &Server,
    identity: &ServerIdentity,
    bytes: &[u8],
) -> (Endpoint, Connection, SendStream, RecvStream) {
    let (endpoint, connection) = unbound_as(server, identity, BULK).await;
    let (mut send, recv) = connection.open_bi().await.unwrap();
    send.write_all(bytes).await.unwrap();
    (endpoint, connection, send, recv)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_transfers_block_no_fetch_and_are_closed() {
    let (server, link, identity) = serve_as();
    let mut silent = Vec::new();
    for _ in 0..40 {
        silent.push(transfer(&server, &identity, &[1]).await);
    }
    let bytes = fetch_model(&link, REQUEST, |_, _| {}).await.unwrap();
    assert_eq!(bytes.len(), 3_000_000);
    for (_, connection, ..) in &silent {
        let closed = tokio::time::timeout(PATIENCE, connection.closed());
        closed.await.unwrap();
    }
    assert_eq!(server.admission().timed_out, 40);
}

/// The bytes of a request, as specified in WIRE.md.
fn wire(request: ModelRequest) -> Vec<u8> {
    let mut bytes = request.participant.0.to_le_bytes().to_vec();
    bytes.extend_from_slice(&request.token.0);
    bytes.extend_from_slice(&request.hash.0.to_le_bytes());
    bytes
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn newer_transfer_of_a_participant_ends_the_older_one() {
    let (server, link, identity) = serve_as();
    let (_endpoint, older, _send, mut recv) = transfer(&server, &identity, &wire(REQUEST)).await;
    // It is under way, and takes no more.
    let mut status = [1];
    recv.read_exact(&mut status).await.unwrap();
    assert_eq!(status, [0]);
    // Its last burst has arrived: a full socket would lose the packet that closes the connection.
    let mut received = 0;
    while received != older.stats().udp_rx.bytes {
        received = older.stats().udp_rx.bytes;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let bytes = fetch_model(&link, REQUEST, |_, _| {}).await.unwrap();
    assert_eq!(bytes.len(), 3_000_000);
    // Should that packet be lost nevertheless: a connection that the server keeps never ends.
    let ended = tokio::time::timeout(PATIENCE, older.closed()).await;
    ended.unwrap();
    let stranger = ModelRequest {
        participant: ParticipantId(9),
        ..REQUEST
    };
    let error = fetch_model(&link, stranger, |_, _| {}).await.unwrap_err();
    assert!(
        matches!(error, TransportError::ModelRefused { .. }),
        "{error}"
    );
}

/// A client that has joined over a connection without the project's driver.
struct Raw {
    _endpoint: Endpoint,
    connection: Connection,
    send: SendStream,
    recv: RecvStream,
    session: ClientSession,
    since: Instant,
    peer: PeerHandle,
    inbox: mpsc::Receiver<PeerInput>,
}

impl Raw {
    async fn join(server: &Server, identity: &ServerIdentity) -> Self {
        let since = Instant::now();
        let (endpoint, connection) = unbound(server, identity).await;
        let (mut send, recv) = connection.open_bi().await.unwrap();
        let mut session = ClientSession::new(hello("raw"), ClientTime::ZERO).unwrap();
        while let Some(bytes) = session.poll_stream() {
            send.write_all(&bytes).await.unwrap();
        }
        let (sender, inbox) = mpsc::channel(1024);
        let accepted = server.accept().await.unwrap();
        let peer = spawn_peer(accepted, PeerId(1), server_clock(since), sender);
        let mut raw = Self {
            _endpoint: endpoint,
            connection,
            send,
            recv,
            session,
            since,
            peer,
            inbox,
        };
        let event = next_input(&mut raw.inbox).await.event;
        assert!(matches!(event, PeerEvent::Hello(_)), "{event:?}");
        assert!(raw.peer.send(welcome(1, 0)));
        while raw.session.participant().is_none() {
            raw.read().await;
        }
        raw
    }

    fn now(&self) -> ClientTime {
        client_clock(self.since)()
    }

    async fn read(&mut self) {
        let mut buffer = [0; 4096];
        let n = tokio::time::timeout(PATIENCE, self.recv.read(&mut buffer));
        let n = n.await.unwrap().unwrap().unwrap();
        let now = self.now();
        self.session.handle_stream(&buffer[..n], now);
    }

    /// Exchanges datagrams only, until one of at least `len` bytes has come.
    async fn datagrams_until(&mut self, len: usize) {
        let start = Instant::now();
        loop {
            assert!(start.elapsed() < PATIENCE, "no such datagram comes");
            let now = self.now();
            self.session.handle_timeout(now);
            while let Some(bytes) = self.session.poll_datagram(now) {
                self.connection.send_datagram(bytes.into()).unwrap();
            }
            let soon =
                tokio::time::timeout(Duration::from_millis(5), self.connection.read_datagram());
            let Ok(bytes) = soon.await else { continue };
            let bytes = bytes.unwrap();
            let now = self.now();
            self.session.handle_datagram(&bytes, now);
            if bytes.len() >= len {
                return;
            }
        }
    }
}

fn long_operation(id: u64) -> Arc<Operation> {
    let PeerMessage::Operation(usual) = operation(id) else {
        unreachable!()
    };
    let kind = OperationKind::Joined {
        participant: ParticipantId(2),
        name: "n".repeat(2000),
        role: Role::Spectator,
        tool: None,
    };
    Arc::new(Operation {
        kind,
        ..usual.as_ref().clone()
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peer_that_never_reads_has_little_encoded_for_it_and_still_gets_datagrams() {
    /// Bytes that quinn takes by default from an unread stream, and the server's own window.
    const WINDOWS: usize = 1_250_000 + 256 * 1024;
    /// 8 MB.
    const OPERATIONS: u64 = 4000;
    let (server, _, identity) = serve_as();
    let mut deaf = Raw::join(&server, &identity).await;
    let operations: Vec<Arc<Operation>> = (0..OPERATIONS).map(long_operation).collect();
    for operation in &operations {
        let message = PeerMessage::Operation(Arc::clone(operation));
        assert!(deaf.peer.send(message));
    }
    // An encoded operation is no longer shared with the queue.
    let encoded = || {
        let done = operations.iter().filter(|o| Arc::strong_count(o) == 1);
        2000 * done.count()
    };
    let list: Arc<[_]> = vec![(ParticipantId(1), DelayReport::default()); 8].into();
    let mut before = 0;
    loop {
        for _ in 0..20 {
            assert!(
                deaf.peer
                    .send_datagram(PeerDatagram::Delays(Arc::clone(&list)))
            );
            // Longer than a heartbeat.
            deaf.datagrams_until(50).await;
        }
        let now = encoded();
        if now == before && now > 0 {
            break;
        }
        before = now;
    }
    // Beyond the high-water mark: one frame, and the bytes that are being written.
    let limit = WINDOWS + OUTBOX_HIGH_WATER_BYTES + 2 * FRAME_MAX_BYTES;
    assert!(before < limit, "{before} B of {limit} are encoded");
    while let Ok(input) = deaf.inbox.try_recv() {
        let is_over = matches!(input.event, PeerEvent::Closed(_));
        assert!(!is_over, "{:?}", input.event);
    }
    // It reads at last, and gets everything.
    let mut next = 0;
    while next < OPERATIONS {
        deaf.read().await;
        while let Some(event) = deaf.session.poll_event() {
            if let ClientEvent::Operation(o) = event {
                assert_eq!(o.id, OperationId(next));
                next += 1;
            }
        }
        let now = deaf.now();
        while let Some(bytes) = deaf.session.poll_datagram(now) {
            deaf.connection.send_datagram(bytes.into()).unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flood_of_requests_is_answered_within_the_rates_and_then_closed() {
    const REQUESTS: u32 = 5000;
    let (server, _, identity) = serve_as();
    let mut raw = Raw::join(&server, &identity).await;
    let start = Instant::now();
    let mut bytes = Vec::new();
    for id in 1..=REQUESTS {
        let kind = RequestKind::TopologyReport {
            version: 0,
            hash: TopologyHash(1),
        };
        let request = Request {
            id: RequestId(id),
            kind,
        };
        raw.session.send_request(request).unwrap();
        bytes.extend(std::iter::from_fn(|| raw.session.poll_stream()).flatten());
    }
    // The server closes the connection in the middle of it.
    let _ = raw.send.write_all(&bytes).await;
    let mut accepted = HashSet::new();
    let reason = loop {
        match next_input(&mut raw.inbox).await.event {
            PeerEvent::Request(request) => assert!(accepted.insert(request.id)),
            PeerEvent::Closed(reason) => break reason,
            _ => {}
        }
    };
    assert!(
        matches!(
            reason,
            CloseReason::Violation(ProtocolError::RequestFlood { .. })
        ),
        "{reason}"
    );
    let mut refused = 0;
    let mut buffer = [0; 4096];
    while let Ok(Some(n)) = raw.recv.read(&mut buffer).await {
        let now = raw.now();
        raw.session.handle_stream(&buffer[..n], now);
        while let Some(event) = raw.session.poll_event() {
            if let ClientEvent::RequestRefused(r) = event {
                assert_eq!(r.reason, RequestRefusal::TooMany);
                assert!(!accepted.contains(&r.id));
                refused += 1;
            }
        }
    }
    let rate = f64::from(REQUESTS_PER_SECOND_MAX);
    let by_rate = rate * (start.elapsed().as_secs_f64() + 1.0);
    assert!(accepted.len() as f64 <= by_rate + f64::from(REQUESTS_BURST_MAX));
    assert!(f64::from(refused) <= by_rate + f64::from(REFUSALS_BURST_MAX));
    assert!(accepted.len() + refused as usize <= REQUESTS as usize / 2);
}
