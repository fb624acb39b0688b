//! The whole client against a hand-written server over real quinn on the loopback interface.
//! Nothing here asserts how fast it is.
#![allow(clippy::unwrap_used)]

mod stand_in;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_client::{ClientError, DeviceKind, JoinOptions, Recording, Sources, Summary};
use palpate_protocol::handshake::{Hello, RefusalReason, Refused, RosterEntry, Welcome};
use palpate_protocol::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, Operation, OperationKind,
};
use palpate_protocol::session::{PeerEvent, PeerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    CertificateHash, Epoch, Grant, JoinLink, ModelHash, ModelInfo, OperationId, ParticipantId,
    ResumeToken, Role, ServerTime, Span, TopologyHash,
};
use palpate_tissue::{Material, Model, Topology, block, cut, encode_model};
use palpate_transport::{
    ModelSource, PeerHandle, PeerId, PeerInput, Server, ServerIdentity, spawn_peer,
};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

const GRANT: Grant = Grant([3; 16]);
const ME: ParticipantId = ParticipantId(1);
const TOKEN: ResumeToken = ResumeToken([5; 16]);
const CELL: f64 = 4e-3;

/// Behaviour of the server after a client's hello.
#[derive(Clone, Copy, PartialEq)]
enum Manner {
    Refuses,
    /// Starts the scripts and cuts once; then waits for the client to leave.
    Plays,
    /// As `Plays`, with a hash that no cut has.
    Lies,
    /// As `Lies` at first, and as `Plays` to who comes back for the log.
    Errs,
    /// Says goodbye after a while.
    SaysGoodbye,
    /// Dies after a while.
    Dies,
    /// As `Plays`, but loses the connection after a while and keeps the seat.
    LosesIt,
}

struct Fake {
    link: JoinLink,
    directory: tempfile::TempDir,
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
        points: (2..9).map(point).collect(),
        width_m: 0.5e-3,
    }
}

fn wire(hash: palpate_tissue::TopologyHash) -> TopologyHash {
    TopologyHash(hash.0)
}

impl Fake {
    fn start(manner: Manner, damaged: bool) -> Self {
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
        let models: ModelSource = Arc::new(move |grant, hash| {
            (grant == GRANT && hash == info.hash).then(|| Arc::clone(&bytes))
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

    fn script(&self) -> PathBuf {
        let path = self.directory.path().join("press.toml");
        let text = "format = \"palpate-script/1\"\n\
            [tool]\nkind = \"probe\"\nradius_mm = 6.0\n\
            [[way]]\nt_s = 0.0\nat_mm = [20.0, 20.0, 26.0]\n\
            [[way]]\nt_s = 0.5\nat_mm = [22.0, 20.0, 25.0]\n";
        std::fs::write(&path, text).unwrap();
        path
    }

    fn options(&self) -> JoinOptions {
        JoinOptions {
            script: Some(self.script()),
            duration: Some(Duration::from_secs(20)),
            realtime: false,
            ..JoinOptions::new(self.link.to_string(), "Ada")
        }
    }

    fn stop(self) {
        self.runtime.shutdown_background();
    }
}

/// One client, from hello to the end.
async fn serve(server: Server, manner: Manner, info: ModelInfo) {
    let since = Instant::now();
    let clock = move || ServerTime::from_micros(since.elapsed().as_micros() as i64 + 9_000_000);
    // Dropped while its task still runs it would say goodbye.
    let mut _lost = None;
    if manner == Manner::LosesIt {
        _lost = Some(lose(&server, info, clock).await);
    }
    if matches!(manner, Manner::Lies | Manner::Errs) {
        lie(&server, info, clock).await;
    }
    let connection = server.accept().await.unwrap();
    let (sender, mut inbox) = mpsc::channel(4096);
    let peer = spawn_peer(connection, PeerId(1), clock, sender);
    while let Some(PeerInput { event, .. }) = inbox.recv().await {
        match event {
            PeerEvent::Hello(hello) if manner == Manner::Refuses => {
                let refused = Refused::because(RefusalReason::Full {
                    role: hello.role,
                    seats: 1,
                });
                peer.send(PeerMessage::Refused(refused));
            }
            PeerEvent::Hello(hello) if manner == Manner::LosesIt => {
                // Who comes back names the seat and has the two operations of before.
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

/// Plays for the first client until its hand moves; then the connection breaks without a word.
async fn lose(
    server: &Server,
    info: ModelInfo,
    clock: impl Fn() -> ServerTime + Copy + Send + 'static,
) -> PeerHandle {
    let connection = server.accept().await.unwrap();
    let (sender, mut inbox) = mpsc::channel(4096);
    // What runs here ends in the middle of whatever it does.
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
    let connection = server.accept().await.unwrap();
    let (sender, mut inbox) = mpsc::channel(4096);
    let peer = spawn_peer(connection, PeerId(0), clock, sender);
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
    cut(&mut topology, &palpate_site::tissue_stroke(&stroke())).unwrap();
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

fn read(path: &Path) -> Recording {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn a_session_is_joined_felt_recorded_and_left() {
    let fake = Fake::start(Manner::Plays, false);
    let record = fake.directory.path().join("run.json");
    let options = JoinOptions {
        record: Some(record.clone()),
        duration: Some(Duration::from_secs(3)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!(
        (summary.operations, summary.cuts, summary.topology_version),
        (2, 1, 1)
    );
    assert!(summary.ticks > 0 && summary.haptic_solves > 0 && summary.view_solves > 0);
    assert!(summary.force_max_n > 0.0 && summary.rtt_ms.is_some());
    assert_eq!(summary.compensation_ms, 30.0);
    let recording = read(&record);
    assert_eq!((recording.name.as_str(), recording.participant), ("Ada", 1));
    assert!(recording.script_started_us.is_some());
    assert!(!recording.haptic.is_empty());
    let kinds: Vec<&str> = recording
        .operations
        .iter()
        .map(|o| o.kind.as_str())
        .collect();
    assert_eq!(kinds, ["started", "cut"]);
    assert_eq!(recording.operations[1].hash, summary.topology_hash);
    let last = recording.views.last().unwrap();
    assert_eq!((last.topology_version, last.delay_us), (1, 30_000));
    assert!(!last.nodes.is_empty() && last.tools[0].participant == 1);
    fake.stop();
}

#[test]
fn a_damaged_model_is_noticed_and_named() {
    let fake = Fake::start(Manner::Plays, true);
    let error = palpate_client::run(&fake.options()).unwrap_err();
    assert!(matches!(error, ClientError::ModelDamaged { .. }), "{error}");
    fake.stop();
}

#[test]
fn a_refusal_is_passed_on_with_its_sentence() {
    let fake = Fake::start(Manner::Refuses, false);
    let error = palpate_client::run(&fake.options()).unwrap_err();
    assert!(
        error.to_string().contains("all 1 seats for the role"),
        "{error}"
    );
    fake.stop();
}

#[test]
fn another_certificate_and_a_missing_script_are_refused_here() {
    let fake = Fake::start(Manner::Plays, false);
    let mut options = fake.options();
    options.script = None;
    let error = palpate_client::run(&options).unwrap_err();
    assert!(error.to_string().contains("--script"), "{error}");
    let mut link = fake.link.clone();
    link.certificate = CertificateHash([0; 32]);
    options = JoinOptions {
        link: link.to_string(),
        ..fake.options()
    };
    let error = palpate_client::run(&options).unwrap_err();
    assert!(error.to_string().contains("certificate"), "{error}");
    fake.stop();
}

#[test]
fn a_replica_that_differs_resyncs_in_the_same_seat() {
    let fake = Fake::start(Manner::Errs, false);
    let options = JoinOptions {
        duration: Some(Duration::from_secs(5)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!((summary.resyncs, summary.reconnects), (1, 0));
    assert_eq!((summary.topology_version, summary.cuts), (1, 1));
    assert!(summary.events.link_lost > 0, "no force meanwhile");
    fake.stop();
}

#[test]
fn a_copy_that_differs_again_ends_the_session() {
    let fake = Fake::start(Manner::Lies, false);
    let error = palpate_client::run(&fake.options()).unwrap_err();
    assert!(matches!(error, ClientError::Diverged { .. }), "{error}");
    assert!(
        error
            .to_string()
            .contains("your replica differs from the server"),
        "{error}"
    );
    assert!(error.to_string().contains("differs again"), "{error}");
    assert_eq!(error.summary().unwrap().resyncs, 1);
    fake.stop();
}

#[test]
fn a_goodbye_is_a_normal_end() {
    let fake = Fake::start(Manner::SaysGoodbye, false);
    let summary = palpate_client::run(&fake.options()).unwrap();
    assert!(
        summary.ended.contains("that is all for today"),
        "{}",
        summary.ended
    );
    fake.stop();
}

#[test]
fn a_server_that_dies_is_said_and_the_figures_are_kept() {
    let fake = Fake::start(Manner::Dies, false);
    let options = JoinOptions {
        reconnect: Duration::from_secs(1),
        ..fake.options()
    };
    let error = palpate_client::run(&options).unwrap_err();
    assert!(matches!(error, ClientError::ServerLost { .. }), "{error}");
    assert!(error.summary().unwrap().ticks > 0);
    fake.stop();
}

#[test]
fn reconnect_keeps_seat_and_replica() {
    let fake = Fake::start(Manner::LosesIt, false);
    let options = JoinOptions {
        duration: Some(Duration::from_secs(5)),
        ..fake.options()
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!(summary.reconnects, 1);
    assert_eq!((summary.operations, summary.cuts), (3, 1));
    assert_eq!(summary.topology_version, 1);
    assert!(summary.events.link_lost > 0, "no force without a server");
    fake.stop();
}

#[test]
fn who_only_looks_needs_no_script_and_sees_the_cut() {
    let fake = Fake::start(Manner::Plays, false);
    let record = fake.directory.path().join("view.json");
    let mut link = fake.link.clone();
    link.role = Role::Spectator;
    let options = JoinOptions {
        record: Some(record.clone()),
        duration: Some(Duration::from_secs(2)),
        ..JoinOptions::new(link.to_string(), "Eve")
    };
    let summary = palpate_client::run(&options).unwrap();
    assert_eq!((summary.ticks, summary.haptic_solves), (0, 0));
    assert_eq!((summary.cuts, summary.device.as_str()), (1, "none"));
    assert!(!read(&record).views.is_empty());
    fake.stop();
}

/// The program itself, because signals go to a whole process.
#[cfg(unix)]
#[test]
fn a_signal_ends_the_program_politely_with_its_summary_as_json() {
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};

    let fake = Fake::start(Manner::Plays, false);
    let mut child = Command::new(env!("CARGO_BIN_EXE_palpate-client"))
        .args([
            "join",
            &fake.link.to_string(),
            "--json",
            "--forget-seat",
            "--name",
            "Ada",
            "--script",
        ])
        .arg(fake.script())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut status = BufReader::new(child.stderr.take().unwrap()).lines();
    let joined = status.find(|line| line.as_ref().unwrap().starts_with("joined as Ada"));
    assert!(joined.is_some());
    let pid = child.id().to_string();
    assert!(
        Command::new("kill")
            .args(["-TERM", &pid])
            .status()
            .unwrap()
            .success()
    );
    // The rest of the status has to go somewhere.
    assert!(status.all(|line| line.is_ok()));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let summary: Summary = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (summary.name.as_str(), summary.ended.as_str()),
        ("Ada", "you left")
    );
    fake.stop();
}

#[test]
fn a_device_in_use_joins_without_a_script() {
    for (kind, source, called) in [
        (DeviceKind::Dhd, "drd.rs", "omega.7"),
        (DeviceKind::OpenHaptics, "hd.rs", "Touch"),
        // What is plugged in is found.
        (DeviceKind::Auto, "drd.rs", "omega.7"),
    ] {
        let fake = Fake::start(Manner::Plays, false);
        let library = stand_in::compiled(source, fake.directory.path());
        let options = JoinOptions {
            device: kind,
            sources: Sources {
                libhd: Some(library.clone()),
                libdrd: Some(library),
                ..Sources::default()
            },
            script: None,
            duration: Some(Duration::from_secs(1)),
            ..fake.options()
        };
        let summary = palpate_client::run(&options).unwrap();
        assert_eq!(summary.device, called);
        assert!(summary.ticks > 0, "{summary}");
        assert_eq!(
            (summary.events.faulted, summary.events.bad_samples),
            (0, 0),
            "{summary}"
        );
        fake.stop();
    }
}
