//! Both ends distinguish how a connection ended, even if the farewell on the stream is lost with the
//! stream.
#![allow(clippy::unwrap_used)]

#[path = "support/session.rs"]
mod session;

use std::time::Instant;

use palpate_protocol::session::{ClientEvent, CloseReason, PeerEvent};
use palpate_transport::{ClientHandle, PeerHandle, PeerId, Server, spawn_peer};
use quinn::VarInt;
use session::{
    admit, next_event, next_input, opening, serve, serve_as, server_clock, unbound, welcome,
};
use tokio::sync::mpsc;

/// The close code of an end that does not reconnect (WIRE.md).
const GOODBYE: u32 = 1;

/// A server with one joined client; returns the server's handle of it.
async fn one_is_in() -> (Server, PeerHandle, ClientHandle) {
    let (server, link) = serve();
    let (sender, mut inbox) = mpsc::channel(1024);
    let inbox_of = (sender, Instant::now());
    let (peer, mut client) = admit(&server, &link, 1, &inbox_of, &mut inbox).await;
    assert!(matches!(
        next_event(&mut client).await,
        ClientEvent::Welcomed(_)
    ));
    (server, peer, client)
}

/// Why the client's session was closed.
async fn ending(client: &mut ClientHandle) -> CloseReason {
    loop {
        if let ClientEvent::Closed(reason) = next_event(client).await {
            return reason;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ended_session_is_distinguished_from_a_lost_host() {
    let (server, _peer, mut client) = one_is_in().await;
    server.close("the host has ended it").await;
    let reason = ending(&mut client).await;
    assert!(
        matches!(&reason, CloseReason::Goodbye(s) if s == "the host has ended it"),
        "{reason}"
    );
    let (server, _peer, mut client) = one_is_in().await;
    drop(server);
    let reason = ending(&mut client).await;
    assert!(
        matches!(reason, CloseReason::ConnectionLost(_)),
        "{reason}: it may come back"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leaving_client_is_distinguished_from_a_lost_one() {
    for (code, leaves) in [(GOODBYE, true), (0, false), (2, false)] {
        let (server, _, identity) = serve_as();
        let (sender, mut inbox) = mpsc::channel(64);
        let (_endpoint, connection) = unbound(&server, &identity).await;
        let (mut send, _recv) = connection.open_bi().await.unwrap();
        send.write_all(&opening("ann")).await.unwrap();
        let accepted = server.accept().await.unwrap();
        let peer = spawn_peer(accepted, PeerId(1), server_clock(Instant::now()), sender);
        while !matches!(next_input(&mut inbox).await.event, PeerEvent::Hello(_)) {}
        assert!(peer.send(welcome(1, 0)));
        connection.close(VarInt::from_u32(code), b"bye");
        loop {
            if let PeerEvent::Closed(reason) = next_input(&mut inbox).await.event {
                let is_lost = matches!(reason, CloseReason::ConnectionLost(_));
                let has_left = matches!(reason, CloseReason::Left);
                assert_eq!((has_left, is_lost), (leaves, !leaves), "{code}: {reason}");
                break;
            }
        }
    }
}
