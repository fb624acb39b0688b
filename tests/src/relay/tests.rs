//! Laws of the relay, through real sockets.

#![allow(clippy::print_stdout)]

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::{Profile, Relay, RelayStats};
use crate::network::{Direction, Jitter, Link, Path};

/// Stop check interval of the echo server.
const STOP_PERIOD: Duration = Duration::from_millis(50);

const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// A server that echoes every packet.
fn echo() -> (SocketAddr, Arc<AtomicBool>, JoinHandle<()>) {
    let socket = UdpSocket::bind(HERE).unwrap();
    socket.set_read_timeout(Some(STOP_PERIOD)).unwrap();
    let address = socket.local_addr().unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = stop.clone();
    let thread = std::thread::spawn(move || {
        let mut buffer = [0; 2048];
        while !stopped.load(Ordering::Relaxed) {
            if let Ok((len, from)) = socket.recv_from(&mut buffer) {
                socket.send_to(&buffer[..len], from).unwrap();
            }
        }
    });
    (address, stop, thread)
}

/// Sends `count` numbered packets one by one; returns the received numbers in order.
fn run(profile: Profile, seed: u64, count: u32) -> (Vec<u32>, RelayStats) {
    let (server, stop, thread) = echo();
    let relay = Relay::start(HERE, server, profile, seed).unwrap();
    let client = UdpSocket::bind(HERE).unwrap();
    client.connect(relay.local_addr()).unwrap();
    client
        .set_read_timeout(Some(Duration::from_millis(400)))
        .unwrap();
    // Read while sending: the operating system keeps only about 250 small packets per socket.
    let reader = client.try_clone().unwrap();
    let reader = std::thread::spawn(move || {
        let mut back = Vec::new();
        let mut buffer = [0; 16];
        while let Ok(len) = reader.recv(&mut buffer) {
            back.push(u32::from_le_bytes(buffer[..len].try_into().unwrap()));
        }
        back
    });
    for i in 0..count {
        client.send(&i.to_le_bytes()).unwrap();
        std::thread::sleep(Duration::from_micros(500));
    }
    let back = reader.join().unwrap();
    stop.store(true, Ordering::Relaxed);
    thread.join().unwrap();
    (back, relay.stats())
}

#[test]
fn lossless_relay_keeps_all_packets_in_order() {
    let link = Link {
        delay_ms: 5.0,
        jitter: Jitter::Uniform { reach_ms: 3.0 },
        ..Link::default()
    };
    let (back, stats) = run(Profile::both("jitter", link), 1, 400);
    assert_eq!(back, (0..400).collect::<Vec<_>>());
    assert_eq!(
        (
            stats.total.sent,
            stats.delivered,
            stats.total.reordered,
            stats.clients
        ),
        (800, 800, 0, 1)
    );
    println!("{stats:?}");
}

#[test]
fn relay_losses_equal_those_of_the_path() {
    let mut profile = Profile::named("lossy").unwrap();
    profile.up.duplicate = 0.0;
    profile.down.duplicate = 0.0;
    let (back, stats) = run(profile.clone(), 42, 400);
    // Losses depend on packet numbers only, so virtual time predicts them.
    let pass = |direction, count| {
        let mut path = Path::new(&profile, 42, 0, direction);
        (0..count).map(|n| path.send(n, 4).len() as u64).sum()
    };
    let up: u64 = pass(Direction::Up, 400);
    let down: u64 = pass(Direction::Down, up);
    assert_eq!(back.len() as u64, down);
    assert!(stats.total.reordered > 0);
    assert_eq!(stats.total.dropped, 400 - up + up - down);
    println!("{stats:?}");
}

#[test]
fn rebind_changes_the_address_at_the_server_only() {
    let server = UdpSocket::bind(HERE).unwrap();
    let relay = Relay::start(
        HERE,
        server.local_addr().unwrap(),
        Profile::named("none").unwrap(),
        1,
    )
    .unwrap();
    let client = UdpSocket::bind(HERE).unwrap();
    client.connect(relay.local_addr()).unwrap();
    let mut buffer = [0; 16];
    let mut there_and_back = |word: &[u8]| {
        client.send(word).unwrap();
        let (len, from) = server.recv_from(&mut buffer).unwrap();
        server.send_to(&buffer[..len], from).unwrap();
        let len = client.recv(&mut buffer).unwrap();
        assert_eq!(&buffer[..len], word);
        from
    };
    let why = relay.rebind(0).unwrap_err();
    assert!(
        why.contains("no flow 0") && why.contains("0 clients"),
        "{why}"
    );
    let before = there_and_back(b"before");
    let address = relay.rebind(0).unwrap();
    let after = there_and_back(b"after");
    assert_ne!(before, after);
    assert_eq!(after.port(), address.port());
    // Packets to the old address are lost; later packets to the new one arrive.
    server.send_to(b"too late", before).unwrap();
    there_and_back(b"again");
    let stats = relay.stats();
    assert_eq!((stats.clients, stats.rebinds), (1, 1));
}

#[test]
fn corrupted_packets_reach_the_server() {
    let link = Link {
        corrupt: 1.0,
        ..Link::default()
    };
    let mut profile = Profile::named("none").unwrap();
    profile.up = link;
    let (server, stop, thread) = echo();
    let relay = Relay::start(HERE, server, profile, 1).unwrap();
    let client = UdpSocket::bind(HERE).unwrap();
    client.connect(relay.local_addr()).unwrap();
    client.send(&[0; 64]).unwrap();
    let mut buffer = [0; 64];
    client.recv(&mut buffer).unwrap();
    let flipped: u32 = buffer.iter().map(|b| b.count_ones()).sum();
    assert!((1..=4).contains(&flipped), "{flipped}");
    stop.store(true, Ordering::Relaxed);
    thread.join().unwrap();
    assert_eq!(relay.stats().total.corrupted, 1);
}
