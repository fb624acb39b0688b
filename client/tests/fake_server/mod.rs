//! A hand-written server over real quinn on the loopback interface.
#![allow(dead_code)] // Each test program uses another part.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_client::JoinOptions;
use palpate_protocol::handshake::{Hello, RefusalReason, Refused, RosterEntry, Welcome};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, Operation, OperationKind,
};
use palpate_protocol::session::{PeerEvent, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    Epoch, Grant, JoinLink, ModelHash, ModelInfo, OperationId, ParticipantId, ResumeToken, Role,
    ServerTime, Span, TopologyHash,
};
use palpate_tissue::file::encode_model;
use palpate_tissue::{Material, Model, Topology, block, cut};
use palpate_transport::{
    ModelSource, PeerHandle, PeerId, PeerInput, Server, ServerIdentity, spawn_peer,
};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

pub(crate) const GRANT: Grant = Grant([3; 16]);
const ME: ParticipantId = ParticipantId(1);
/// The number of a participant that joined again.
pub(crate) const ME_AGAIN: ParticipantId = ParticipantId(3);
const TOKEN: ResumeToken = ResumeToken([5; 16]);
/// Clients that a full server refuses before it has room.
const REFUSED_FIRST: usize = 2;
const CELL: f64 = 4e-3;

/// Behaviour of the server after a client's hello.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Manner {
    /// Is full for every client.
    IsFull,
    /// Is full for the first clients; then as `Plays`.
    WasFull,
    /// Starts the scripts and cuts once; then waits for the client to leave.
    Plays,
    /// As `Plays`, with a hash that no cut has.
    Lies,
    /// As `Lies` at first, and as `Plays` to a client that returns for the log.
    Errs,
    /// Says goodbye after a while.
    SaysGoodbye,
    /// Dies after a while.
    Dies,
    /// As `Plays`, but loses the connection after a while and keeps the seat.
    LosesIt,
    /// As `Plays`, but loses the connection and the seat; then as `Plays` to who joins again.
    LosesSeat,
}

pub(crate) struct Fake {
    pub(crate) link: JoinLink,
    pub(crate) directory: tempfile::TempDir,
    runtime: Runtime,
}

fn model() -> Model {
    let material = Material {
        name: "soft".into(),
        young_pa: 10e3,
        density_kg_m3: 1000.0,
        friction_static: 0.4,
        friction_dynamic: 0.3,
        source: "test".into(),
        ..Material::default()
    };
    block([10, 10, 6], CELL, &material, 1)
}

fn stroke() -> CutStroke {
    let point = |i: u32| BladePoint {
        tip_m: [f64::from(i) * CELL, 5.2 * CELL, 3.5 * CELL],
        axis: [0.0, 0.0, 1.0],
        depth_m: 4.0 * CELL,
    };
    CutStroke {
        began: ServerTime::ZERO,
        joins: false,
        points: (2..9).map(|i| point(i).rounded()).collect(),
        width_m: 0.5e-3,
    }
}

fn wire(hash: palpate_tissue::TopologyHash) -> TopologyHash {
    TopologyHash(hash.0)
}

impl Fake {
    pub(crate) fn start(manner: Manner, damaged: bool) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let mut bytes = encode_model(&model());
        let info = ModelInfo {
            hash: ModelHash(xxhash_rust::xxh3::xxh3_64(&bytes)),
            bytes: bytes.len() as u64,
        };
        if damaged {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
        }
        let bytes: Arc<[u8]> = bytes.into();
        let models: ModelSource = Arc::new(move |participant, token, hash| {
            let has_seat = participant == ME && token.matches(&TOKEN);
            (has_seat && hash == info.hash).then(|| Arc::clone(&bytes))
        });
        let identity = ServerIdentity::generate().unwrap();
        let address = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
        let guard = runtime.enter();
        let server = Server::bind(address, &identity, models).unwrap();
        drop(guard);
        let link = JoinLink {
            host: "127.0.0.1".to_owned(),
            port: server.local_addr().port(),
            role: Role::Trainee,
            certificate: identity.certificate_hash(),
            grant: GRANT,
        };
        runtime.spawn(serve(server, manner, info));
        Self {
            link,
            directory: tempfile::tempdir().unwrap(),
            runtime,
        }
    }

    pub(crate) fn script(&self) -> PathBuf {
        let path = self.directory.path().join("press.toml");
        let text = "format = \"palpate-script/1\"\n\
            [tool]\nkind = \"probe\"\nradius_mm = 6.0\n\
            [[way]]\nt_s = 0.0\nat_mm = [20.0, 20.0, 26.0]\n\
            [[way]]\nt_s = 0.5\nat_mm = [22.0, 20.0, 25.0]\n";
        std::fs::write(&path, text).unwrap();
        path
    }

    pub(crate) fn options(&self) -> JoinOptions {
        JoinOptions {
            script: Some(self.script()),
            duration: Some(Duration::from_secs(20)),
            realtime: false,
            ..JoinOptions::new(self.link.to_string(), "Ada")
        }
    }

    pub(crate) fn stop(self) {
        self.runtime.shutdown_background();
    }
}

/// One client, from hello to the end.
async fn serve(server: Server, manner: Manner, info: ModelInfo) {
    let since = Instant::now();
    let clock = move || ServerTime::from_micros(since.elapsed().as_micros() as i64 + 9_000_000);
    // Dropped while its task still runs it would say goodbye.
    let mut _lost = None;
    if matches!(manner, Manner::LosesIt | Manner::LosesSeat) {
        _lost = Some(lose(&server, info, clock).await);
    }
    let full = RefusalReason::Full {
        role: Role::Trainee,
        seats: 1,
    };
    match manner {
        Manner::IsFull => loop {
            refuse(&server, &full, clock).await;
        },
        Manner::WasFull => {
            for _ in 0..REFUSED_FIRST {
                refuse(&server, &full, clock).await;
            }
        }
        Manner::LosesSeat => refuse(&server, &RefusalReason::NoSuchSeat, clock).await,
        _ => {}
    }
    if matches!(manner, Manner::Lies | Manner::Errs) {
        lie(&server, info, clock).await;
    }
    let (peer, mut inbox) = next_peer(&server, PeerId(1), clock).await;
    while let Some(PeerInput { event, .. }) = inbox.recv().await {
        match event {
            PeerEvent::Hello(hello) if manner == Manner::LosesSeat => {
                assert!(hello.resume.is_none(), "the seat is gone");
                let PeerMessage::Welcome(first) = welcome(info, clock(), &hello) else {
                    unreachable!()
                };
                peer.send(PeerMessage::Welcome(Box::new(Welcome {
                    participant: ME_AGAIN,
                    ..*first
                })));
                play(&peer, manner, clock());
            }
            PeerEvent::Hello(hello) if manner == Manner::LosesIt => {
                // A returning client names the seat and has the two operations of before.
                let seat = hello.resume.unwrap();
                assert!(seat.participant == ME && seat.token.matches(&TOKEN));
                assert_eq!(seat.next_operation, OperationId(2));
                let PeerMessage::Welcome(first) = welcome(info, clock(), &hello) else {
                    unreachable!()
                };
                peer.send(PeerMessage::Welcome(Box::new(Welcome {
                    first_operation: OperationId(2),
                    operations_so_far: 3,
                    topology_version: seat.topology_version,
                    topology_hash: seat.topology_hash,
                    ..*first
                })));
                peer.send(PeerMessage::Operation(Arc::new(Operation {
                    id: OperationId(2),
                    at: clock(),
                    author: ME,
                    topology_version_before: seat.topology_version,
                    topology_version_after: seat.topology_version,
                    hash_after: seat.topology_hash,
                    kind: OperationKind::Reconnected { participant: ME },
                })));
            }
            PeerEvent::Hello(hello) => {
                assert_eq!(hello.tool.is_some(), hello.role.has_tool());
                if matches!(manner, Manner::Lies | Manner::Errs) {
                    let seat = hello.resume.unwrap();
                    assert!(seat.participant == ME && seat.token.matches(&TOKEN));
                    assert_eq!(seat.next_operation, OperationId(0), "nothing in hand");
                }
                peer.send(welcome(info, clock(), &hello));
                play(&peer, manner, clock());
            }
            PeerEvent::Closed(_) => break,
            // Motion says that the hand is alive: now the end can come.
            PeerEvent::Motion(_) if manner == Manner::Dies => break,
            PeerEvent::Motion(_) if manner == Manner::SaysGoodbye => {
                peer.send(PeerMessage::Goodbye("that is all for today".into()));
            }
            _ => {}
        }
    }
    if manner == Manner::Dies {
        drop(server);
    } else {
        // The endpoint lives until the client has left.
        tokio::time::sleep(Duration::from_secs(60)).await;
    }
}

/// The next client, and its events.
async fn next_peer(
    server: &Server,
    id: PeerId,
    clock: impl Fn() -> ServerTime + Send + 'static,
) -> (PeerHandle, mpsc::Receiver<PeerInput>) {
    let connection = server.accept().await.unwrap();
    let (sender, inbox) = mpsc::channel(4096);
    (spawn_peer(connection, id, clock, sender), inbox)
}

/// Refuses the next client.
async fn refuse(
    server: &Server,
    reason: &RefusalReason,
    clock: impl Fn() -> ServerTime + Copy + Send + 'static,
) {
    let (peer, mut inbox) = next_peer(server, PeerId(0), clock).await;
    while let Some(PeerInput { event, .. }) = inbox.recv().await {
        match event {
            PeerEvent::Hello(_) => {
                peer.send(PeerMessage::Refused(Refused::because(reason.clone())));
            }
            PeerEvent::Closed(_) => break,
            _ => {}
        }
    }
}

/// Plays for the first client until its hand moves, or for half a second; then the connection breaks without a word.
async fn lose(
    server: &Server,
    info: ModelInfo,
    clock: impl Fn() -> ServerTime + Copy + Send + 'static,
) -> PeerHandle {
    let connection = server.accept().await.unwrap();
    let (sender, mut inbox) = mpsc::channel(4096);
    // Everything here ends in the middle of whatever it does.
    let breakable = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let peer = {
        let _inside = breakable.enter();
        spawn_peer(connection, PeerId(0), clock, sender)
    };
    while let Some(PeerInput { event, .. }) = inbox.recv().await {
        match event {
            PeerEvent::Hello(hello) => {
                peer.send(welcome(info, clock(), &hello));
                play(&peer, Manner::Plays, clock());
                if !hello.role.has_tool() {
                    tokio::time::sleep(Duration::from_millis(500)).await;
                    break;
                }
            }
            PeerEvent::Motion(_) => break,
            _ => {}
        }
    }
    breakable.shutdown_background();
    peer
}

/// Tells the first client of a cut that makes another topology, until it goes.
async fn lie(
    server: &Server,
    info: ModelInfo,
    clock: impl Fn() -> ServerTime + Copy + Send + 'static,
) {
    let (peer, mut inbox) = next_peer(server, PeerId(0), clock).await;
    while let Some(PeerInput { event, .. }) = inbox.recv().await {
        match event {
            PeerEvent::Hello(hello) => {
                peer.send(welcome(info, clock(), &hello));
                play(&peer, Manner::Lies, clock());
            }
            PeerEvent::Closed(_) => break,
            _ => {}
        }
    }
}

fn welcome(info: ModelInfo, now: ServerTime, hello: &Hello) -> PeerMessage {
    let entry = |participant: ParticipantId, name: &str, role, tool| RosterEntry {
        participant,
        name: name.to_owned(),
        role,
        tool,
    };
    let probe = ToolDescription::probe(6e-3);
    let roster = vec![
        entry(ME, &hello.name, hello.role, hello.tool),
        entry(ParticipantId(2), "Bob", Role::Trainee, Some(probe)),
    ];
    PeerMessage::Welcome(Box::new(Welcome {
        participant: ME,
        epoch: Epoch(1),
        role: hello.role,
        server_time: now,
        model: info,
        roster,
        topology_version: 0,
        topology_hash: wire(Topology::new(Arc::new(model())).hash()),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far: 0,
        compensation: CompensationSettings {
            mode: CompensationMode::Fixed,
            initial_delay_us: 30_000,
        },
        tick_hz: 250,
        session_started_at: None,
        resume_token: TOKEN,
    }))
}

fn play(peer: &PeerHandle, manner: Manner, now: ServerTime) {
    let mut topology = Topology::new(Arc::new(model()));
    let before = wire(topology.hash());
    cut(
        &mut topology,
        &palpate_site::tissue_stroke(ParticipantId::SERVER, &stroke()).path,
    )
    .unwrap();
    let after = if manner == Manner::Lies {
        TopologyHash(1)
    } else {
        wire(topology.hash())
    };
    let soon = now + Span::from_millis(200);
    let operation = |id, versions: (u32, u32), hash_after, kind| {
        PeerMessage::Operation(Arc::new(Operation {
            id: OperationId(id),
            at: soon,
            author: ParticipantId::SERVER,
            topology_version_before: versions.0,
            topology_version_after: versions.1,
            hash_after,
            kind,
        }))
    };
    peer.send(operation(
        0,
        (0, 0),
        before,
        OperationKind::Started { at: soon },
    ));
    peer.send(operation(1, (0, 1), after, OperationKind::Cut(stroke())));
}
