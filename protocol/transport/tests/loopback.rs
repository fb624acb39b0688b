//! Sessions over real quinn on the loopback interface.
#![allow(clippy::unwrap_used)]

#[path = "support/relay.rs"]
mod relay;
#[path = "support/session.rs"]
mod session;

use std::sync::Arc;
use std::time::{Duration, Instant};

use palpate_protocol::handshake::{PROTOCOL_VERSION, Preamble, RefusalReason};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::request::RequestKind;
use palpate_protocol::session::{
    ClientEvent, CloseReason, MotionRound, PeerDatagram, PeerEvent, PeerMessage,
};
use palpate_protocol::{
    CertificateHash, ClientTime, LocalSample, ModelHash, OperationId, ParticipantId, Pose,
    ResumeToken, Role, ToolTrack,
};
use palpate_transport::{
    ClientCommand, ModelRequest, ModelSource, PeerId, Server, ServerIdentity, TransportError,
    connect, fetch_model, spawn_peer,
};
use relay::{Relay, Way};
use session::{
    ANY_PORT, PATIENCE, REQUEST, admit, client_clock, join, next_event, next_input, opening,
    operation, serve, server_clock, welcome,
};
use tokio::sync::mpsc;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_goes_from_hello_to_leave() {
    let (server, link) = serve();
    let (sender, mut receiver) = mpsc::channel(1024);
    let inbox = (sender, Instant::now());
    let (peer, mut client) = admit(&server, &link, 1, &inbox, &mut receiver).await;
    for id in 0..5 {
        assert!(peer.send(operation(id)));
    }
    let (mut operations, mut caught_up, mut clock) = (Vec::new(), None, None);
    assert!(matches!(
        next_event(&mut client).await,
        ClientEvent::Welcomed(_)
    ));
    while operations.len() < 5 || clock.is_none() {
        match next_event(&mut client).await {
            ClientEvent::Operation(o) => operations.push(o.id.0),
            ClientEvent::CaughtUp => caught_up = Some(operations.len()),
            ClientEvent::Clock(map) => clock = Some(map),
            _ => {}
        }
    }
    assert_eq!((operations, caught_up), (vec![0, 1, 2, 3, 4], Some(3)));
    let map = clock.unwrap();
    let offset = map.to_server(ClientTime::ZERO).as_micros() - 5_000_000;
    assert!(
        offset.abs() <= map.error_bound().as_micros() + 1,
        "{offset} µs"
    );

    let now = client_clock(inbox.1)();
    let samples: Vec<LocalSample> = (0..4_i64)
        .map(|i| LocalSample {
            time: now - palpate_protocol::Span::from_millis(3 - i),
            pose: Pose {
                position_m: [0.01 * i as f64, 0.0, 0.0],
                ..Pose::IDENTITY
            },
            ..LocalSample::default()
        })
        .collect();
    client
        .commands
        .send(ClientCommand::Motion(samples))
        .await
        .unwrap();
    let back = loop {
        if let PeerEvent::Motion(motion) = next_input(&mut receiver).await.event {
            break motion;
        }
    };
    assert_eq!(back.samples.len(), 4);
    let track = |n| ToolTrack {
        participant: ParticipantId(n),
        samples: back.samples.clone(),
        late: back.late,
    };
    let round = MotionRound {
        released: back.arrived,
        tracks: vec![track(1), track(2)],
    };
    assert!(peer.send_datagram(PeerDatagram::Motion(Arc::new(round))));
    loop {
        if let ClientEvent::Motion(track) = next_event(&mut client).await {
            assert_eq!(
                track.participant,
                ParticipantId(2),
                "the own tool is omitted"
            );
            break;
        }
    }
    client
        .commands
        .send(ClientCommand::Request(RequestKind::Leave))
        .await
        .unwrap();
    loop {
        if let PeerEvent::Closed(reason) = next_input(&mut receiver).await.event {
            assert_eq!(reason, CloseReason::Left);
            break;
        }
    }
    loop {
        if let ClientEvent::Closed(reason) = next_event(&mut client).await {
            assert_eq!(reason, CloseReason::Left);
            break;
        }
    }
    server.close("done").await;
}

#[tokio::test]
async fn wrong_certificate_is_rejected_with_both_hashes() {
    let (_server, mut link) = serve();
    link.certificate = CertificateHash([1; 32]);
    let error = connect(&link).await.err().unwrap();
    assert!(
        matches!(error, TransportError::WrongCertificate { .. }),
        "{error}"
    );
    assert!(error.to_string().contains("0101"));
}

#[tokio::test]
async fn client_of_another_version_receives_the_server_version() {
    let (server, link) = serve();
    let (sender, mut receiver) = mpsc::channel(16);
    let mut connection = connect(&link).await.unwrap();
    connection
        .write(
            &Preamble {
                version: 99,
                status: 0,
            }
            .to_bytes(),
        )
        .await
        .unwrap();
    let accepted = server.accept().await.unwrap();
    let _peer = spawn_peer(accepted, PeerId(1), server_clock(Instant::now()), sender);
    let mut answer = Vec::new();
    let mut buffer = [0; 1024];
    while let Ok(Some(n)) = connection.read(&mut buffer).await {
        answer.extend_from_slice(&buffer[..n]);
    }
    let preamble = Preamble::from_bytes(answer[..8].try_into().unwrap()).unwrap();
    assert_eq!((preamble.version, preamble.status), (PROTOCOL_VERSION, 1));
    let sentence = String::from_utf8_lossy(&answer[10..]).into_owned();
    assert!(sentence.contains(&format!("speaks protocol version {PROTOCOL_VERSION}")));
    let closed = next_input(&mut receiver).await.event;
    assert!(
        matches!(closed, PeerEvent::Closed(CloseReason::Violation(_))),
        "{closed:?}"
    );
}

#[tokio::test]
async fn error_names_the_version_of_another_server() {
    let (server, link) = serve();
    let mut client = join(&link, "new", Instant::now()).await;
    let mut old = server.accept().await.unwrap();
    old.write(
        &Preamble {
            version: 99,
            status: 0,
        }
        .to_bytes(),
    )
    .await
    .unwrap();
    match next_event(&mut client).await {
        ClientEvent::Closed(CloseReason::Refused(refused)) => {
            assert_eq!(refused.reason, RefusalReason::Version { server_speaks: 99 });
            assert!(refused.sentence.contains("speaks protocol version 99"));
        }
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn noise_is_counted_and_harms_no_session() {
    let (server, link) = serve();
    let (sender, mut receiver) = mpsc::channel(1024);
    let inbox = (sender, Instant::now());
    let (good_peer, mut good) = admit(&server, &link, 1, &inbox, &mut receiver).await;
    assert!(good_peer.send(operation(0)));

    // At the port.
    let socket = tokio::net::UdpSocket::bind(ANY_PORT).await.unwrap();
    for len in 0..200 {
        let noise: Vec<u8> = (0..len * 7).map(|i| (i * 31 + len) as u8).collect();
        socket.send_to(&noise, server.local_addr()).await.unwrap();
    }
    // Inside a connection: datagrams before the handshake, then nonsense on the stream.
    let mut bad = connect(&link).await.unwrap();
    bad.write(&Preamble::OURS.to_bytes()).await.unwrap();
    for i in 0..50_u8 {
        bad.send_datagram(vec![i; usize::from(i) + 1]);
    }
    let accepted = server.accept().await.unwrap();
    let bad_peer = spawn_peer(accepted, PeerId(2), server_clock(inbox.1), inbox.0.clone());
    tokio::time::sleep(Duration::from_millis(300)).await;
    bad.write(&[0xff; 64]).await.unwrap();
    loop {
        let input = next_input(&mut receiver).await;
        if let PeerEvent::Closed(reason) = input.event {
            assert_eq!(input.peer, PeerId(2), "only the bad one is closed");
            assert!(matches!(reason, CloseReason::Violation(_)), "{reason}");
            break;
        }
    }
    tokio::time::sleep(Duration::from_millis(700)).await;
    assert!(bad_peer.stats().link.noise.early > 0);
    // The other session continues.
    assert!(good_peer.send(operation(1)));
    loop {
        if let ClientEvent::Operation(o) = next_event(&mut good).await
            && o.id == OperationId(1)
        {
            break;
        }
    }
}

#[tokio::test]
async fn model_is_delivered_to_a_participant_with_its_token() {
    let (server, link) = serve();
    let mut last = (0, 0);
    let bytes = fetch_model(&link, REQUEST, |done, total| last = (done, total))
        .await
        .unwrap();
    assert_eq!((bytes.len(), last), (3_000_000, (3_000_000, 3_000_000)));
    assert!(bytes.iter().all(|b| *b == 0xab));
    let strangers = [
        ModelRequest {
            participant: ParticipantId(2),
            ..REQUEST
        },
        ModelRequest {
            token: ResumeToken([5; 16]),
            ..REQUEST
        },
        ModelRequest {
            hash: ModelHash(1),
            ..REQUEST
        },
    ];
    for stranger in strangers {
        let error = fetch_model(&link, stranger, |_, _| {}).await.unwrap_err();
        assert!(
            matches!(error, TransportError::ModelRefused { .. }),
            "{error}"
        );
    }
    assert_eq!(server.admission().transfers_refused, 3);
}

#[tokio::test]
async fn port_in_use_is_named() {
    let (server, _) = serve();
    let identity = ServerIdentity::generate().unwrap();
    let models: ModelSource = Arc::new(|_, _, _| None);
    let error = Server::bind(server.local_addr(), &identity, models)
        .err()
        .unwrap();
    assert!(matches!(error, TransportError::PortTaken { .. }), "{error}");
    assert!(error.to_string().contains(&server.local_addr().to_string()));
}

#[tokio::test]
async fn silent_address_gives_a_readable_error() {
    let socket = tokio::net::UdpSocket::bind(ANY_PORT).await.unwrap();
    let (_server, mut link) = serve();
    link.port = socket.local_addr().unwrap().port();
    let error = connect(&link).await.err().unwrap();
    assert!(matches!(error, TransportError::NoAnswer { .. }), "{error}");
}

/// The number in the next datagram.
async fn next_number(connection: &palpate_transport::Connection) -> u64 {
    let bytes = tokio::time::timeout(PATIENCE, connection.read_datagram())
        .await
        .unwrap()
        .unwrap();
    u64::from_le_bytes(bytes.try_into().unwrap())
}

/// Numbers from here to there, 4 ms apart, until one of them has arrived.
async fn numbers_pass(
    from: &mut palpate_transport::Connection,
    to: &palpate_transport::Connection,
    first: u64,
) {
    for n in first.. {
        assert!(n < first + 5_000, "no datagram passes");
        from.send_datagram(n.to_le_bytes().to_vec());
        let soon = tokio::time::timeout(Duration::from_millis(4), next_number(to));
        if soon.await.is_ok_and(|seen| seen >= first) {
            return;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_on_a_new_socket_keeps_its_datagrams_and_stream() {
    let (server, link) = serve();
    let mut client = connect(&link).await.unwrap();
    client.write(b"one").await.unwrap();
    let mut served = server.accept().await.unwrap();
    served.admit();
    let mut buffer = [0; 16];
    assert_eq!(served.read(&mut buffer).await.unwrap(), Some(3));
    let old = served.remote_address();
    for round in 1..=3 {
        client.rebind().unwrap();
        numbers_pass(&mut client, &served, round * 10_000).await;
        numbers_pass(&mut served, &client, round * 10_000).await;
        client.write(b"more").await.unwrap();
        assert_eq!(served.read(&mut buffer).await.unwrap(), Some(4));
        served.write(b"back").await.unwrap();
        assert_eq!(client.read(&mut buffer).await.unwrap(), Some(4));
    }
    assert_ne!(served.remote_address().port(), old.port());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_survives_a_port_change_of_the_gateway() {
    let (server, mut link) = serve();
    let path = Relay::start(
        &[server.local_addr()],
        Way::delayed(Duration::from_millis(10)),
    );
    link.port = path.addresses()[0].port();
    let (sender, mut receiver) = mpsc::channel(1024);
    let inbox = (sender, Instant::now());
    let (peer, mut client) = admit(&server, &link, 1, &inbox, &mut receiver).await;
    for id in 0..10 {
        if id % 3 == 1 {
            path.forget();
        }
        assert!(peer.send(operation(id)));
        let now = client_clock(inbox.1)();
        let samples = (0..4_i64).map(|i| LocalSample {
            time: now - palpate_protocol::Span::from_millis(3 - i),
            pose: Pose::IDENTITY,
            ..LocalSample::default()
        });
        client
            .commands
            .send(ClientCommand::Motion(samples.collect()))
            .await
            .unwrap();
        loop {
            match next_event(&mut client).await {
                ClientEvent::Operation(o) if o.id == OperationId(id) => break,
                ClientEvent::Closed(why) => panic!("{why}"),
                _ => {}
            }
        }
    }
    // Motion passes after the last change, by which everything earlier has arrived.
    while receiver.try_recv().is_ok() {}
    for _ in 0..500 {
        let now = client_clock(inbox.1)();
        let samples = (0..4_i64).map(|i| LocalSample {
            time: now - palpate_protocol::Span::from_millis(3 - i),
            ..LocalSample::default()
        });
        let motion = ClientCommand::Motion(samples.collect());
        client.commands.send(motion).await.unwrap();
        tokio::time::sleep(Duration::from_millis(4)).await;
        match receiver.try_recv().map(|input| input.event) {
            Ok(PeerEvent::Motion(_)) => return,
            Ok(PeerEvent::Closed(why)) => panic!("{why}"),
            _ => {}
        }
    }
    panic!("no motion passes");
}

#[tokio::test]
async fn refused_client_that_reads_nothing_does_not_keep_the_task() {
    /// More than the windows of both ends take: 8 MB of names.
    const OPERATIONS: u64 = 4000;
    let (server, link) = serve();
    let since = Instant::now();
    let (sender, mut inbox) = mpsc::channel(64);
    let mut deaf = connect(&link).await.unwrap();
    deaf.write(&opening("deaf")).await.unwrap();
    let connection = server.accept().await.unwrap();
    let peer = spawn_peer(connection, PeerId(1), server_clock(since), sender.clone());
    assert!(matches!(
        next_input(&mut inbox).await.event,
        PeerEvent::Hello(_)
    ));
    assert!(peer.send(welcome(1, OPERATIONS)));
    for id in 0..OPERATIONS {
        let PeerMessage::Operation(usual) = operation(id) else {
            unreachable!()
        };
        let long = Operation {
            kind: OperationKind::Joined {
                participant: ParticipantId(2),
                name: "n".repeat(2000),
                role: Role::Spectator,
                tool: None,
            },
            ..usual.as_ref().clone()
        };
        assert!(peer.send(PeerMessage::Operation(Arc::new(long))));
    }
    // No request begins like this.
    deaf.write(&[0xff; 64]).await.unwrap();
    assert!(matches!(
        next_input(&mut inbox).await.event,
        PeerEvent::Closed(CloseReason::Violation(_))
    ));
    // The connection is open, and nothing was read from it; the task ends nevertheless.
    let ended = async {
        while peer.send(operation(OPERATIONS)) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(PATIENCE, ended).await.unwrap();
    drop(deaf);
}
