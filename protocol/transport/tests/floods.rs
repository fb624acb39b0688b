//! A peer above its rate is capped and does not harm other peers.
#![allow(clippy::unwrap_used)]

#[path = "support/session.rs"]
mod session;

use std::time::{Duration, Instant};

use palpate_protocol::session::{ClientSession, PeerEvent};
use palpate_protocol::{ClientTime, JoinLink, ServerTime};
use palpate_transport::{
    PeerHandle, PeerId, PeerInput, Server, ServerIdentity, connect, spawn_client, spawn_peer,
};
use quinn::Connection;
use session::{PATIENCE, hello, serve_as, unbound};
use tokio::sync::mpsc;

/// The rate cap of one connection, bytes per second; the flood sends twice as much.
const MAY: f64 = 1_250_000.0;

/// How long it floods.
const FLOOD: Duration = Duration::from_secs(2);

/// The inbox of a room, and the events of its peers.
struct Room {
    server: Server,
    link: JoinLink,
    identity: ServerIdentity,
    sender: mpsc::Sender<PeerInput>,
    inbox: mpsc::Receiver<PeerInput>,
    since: Instant,
}

impl Room {
    fn open() -> Self {
        let (server, link, identity) = serve_as();
        let (sender, inbox) = mpsc::channel(1024);
        Self {
            server,
            link,
            identity,
            sender,
            inbox,
            since: Instant::now(),
        }
    }

    async fn accept(&self, id: u64) -> PeerHandle {
        let since = self.since;
        let clock = move || ServerTime::from_micros(since.elapsed().as_micros() as i64);
        let mut connection = self.server.accept().await.unwrap();
        // The flood comes before the hello and takes longer than a pending connection may.
        connection.admit();
        spawn_peer(connection, PeerId(id), clock, self.sender.clone())
    }

    /// Waits until this peer has introduced itself; no peer may be closed meanwhile.
    async fn hears_hello_of(&mut self, id: u64) {
        loop {
            let input = tokio::time::timeout(PATIENCE, self.inbox.recv()).await;
            let PeerInput { peer, event, .. } = input.unwrap().unwrap();
            match event {
                PeerEvent::Hello(_) if peer == PeerId(id) => return,
                PeerEvent::Closed(why) => panic!("{peer:?} was closed: {why}"),
                _ => {}
            }
        }
    }
}

/// Sends datagrams of `len` bytes at `per_second` for [`FLOOD`]; returns their number.
async fn flood(connection: &Connection, len: usize, per_second: f64) -> u64 {
    let start = Instant::now();
    let mut sent = 0;
    while start.elapsed() < FLOOD {
        while (sent as f64) < start.elapsed().as_secs_f64() * per_second {
            let bytes = vec![0xee; len].into();
            connection.send_datagram_wait(bytes).await.unwrap();
            sent += 1;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    sent
}

/// One peer floods while another joins; then the first continues undisturbed.
async fn flood_is_capped_and_harms_no_other_peer(len: usize, per_second: f64) {
    let mut room = Room::open();
    let (_endpoint, bad) = unbound(&room.server, &room.identity).await;
    let (mut send, mut recv) = bad.open_bi().await.unwrap();
    let mut session = ClientSession::new(hello("loud"), ClientTime::ZERO).unwrap();
    let preamble = session.poll_stream().unwrap();
    send.write_all(&preamble).await.unwrap();
    let loud = room.accept(1).await;

    let flooding = tokio::spawn({
        let bad = bad.clone();
        async move { flood(&bad, len, per_second).await }
    });
    tokio::time::sleep(FLOOD / 2).await;
    let since = Instant::now();
    let clock = move || ClientTime::from_micros(since.elapsed().as_micros() as i64);
    let other = ClientSession::new(hello("quiet"), clock()).unwrap();
    let _quiet = spawn_client(connect(&room.link).await.unwrap(), other, clock);
    let quiet_peer = room.accept(2).await;
    room.hears_hello_of(2).await;
    let sent = flooding.await.unwrap();

    let mut buffer = [0; 1024];
    while let Some(bytes) = session.poll_stream() {
        send.write_all(&bytes).await.unwrap();
    }
    let n = recv.read(&mut buffer).await.unwrap().unwrap();
    session.handle_stream(&buffer[..n], ClientTime::ZERO);
    while let Some(bytes) = session.poll_stream() {
        send.write_all(&bytes).await.unwrap();
    }
    room.hears_hello_of(1).await;

    // Figures are renewed ten times a second.
    tokio::time::sleep(Duration::from_millis(300)).await;
    let (loud, quiet) = (loud.stats(), quiet_peer.stats());
    let taken = loud.link.noise.total();
    assert!(loud.path.refused_datagrams > 0, "{loud:?}");
    assert!(taken + loud.path.refused_datagrams <= sent, "{loud:?}");
    assert!(taken < sent * 9 / 10, "{taken} of {sent} were taken");
    assert_eq!(quiet.path.refused_datagrams, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sender_at_twice_the_cap_is_limited_and_stays_in_the_session() {
    flood_is_capped_and_harms_no_other_peer(1100, 2.0 * MAY / 1100.0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flood_of_tiny_datagrams_is_limited_by_number() {
    flood_is_capped_and_harms_no_other_peer(1, 20_000.0).await;
}
