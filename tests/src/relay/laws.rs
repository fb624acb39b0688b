//! What the relay owes, through real sockets.

#![allow(clippy::print_stdout)]

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::{Profile, RebindError, Relay, RelayStats};
use crate::network::{Direction, Jitter, Link, Path};

/// How often the echo looks whether it is to stop.
const STOP_PERIOD: Duration = Duration::from_millis(50);

const HERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// A server that answers every packet with itself.
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

/// Sends `count` numbered packets one by one and gives the numbers that came back, in order.
fn run(profile: Profile, seed: u64, count: u32) -> (Vec<u32>, RelayStats) {
    let (server, stop, thread) = echo();
    let relay = Relay::start(HERE, server, profile, seed).unwrap();
    let client = UdpSocket::bind(HERE).unwrap();
    client.connect(relay.local_addr()).unwrap();
    client
        .set_read_timeout(Some(Duration::from_millis(400)))
        .unwrap();
    // Read while sending: the system keeps only some 250 small packets for a socket.
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
fn without_loss_and_reordering_everything_comes_back_in_order() {
    let link = Link {
        delay_ms: 5.0,
        jitter: Jitter::Uniform { reach_ms: 3.0 },
        ..Link::default()
    };
    let (back, stats) = run(Profile::both("jitter", link), 1, 400);
    assert_eq!(back, (0..400).collect::<Vec<_>>());
    assert_eq!(
        (stats.sent, stats.delivered, stats.reordered, stats.clients),
        (800, 800, 0, 1)
    );
    println!("{stats:?}");
}

#[test]
fn what_comes_back_is_what_the_path_says() {
    let mut profile = Profile::named("lossy").unwrap();
    profile.up.duplicate = 0.0;
    profile.down.duplicate = 0.0;
    let (back, stats) = run(profile.clone(), 42, 400);
    // Its losses go by the packets' numbers, so virtual time tells what they were.
    let pass = |direction, count| {
        let mut path = Path::new(&profile, 42, 0, direction);
        (0..count).map(|n| path.send(n, 4).len() as u64).sum()
    };
    let up: u64 = pass(Direction::Up, 400);
    let down: u64 = pass(Direction::Down, up);
    assert_eq!(back.len() as u64, down);
    assert!(stats.reordered > 0);
    assert_eq!(stats.dropped, 400 - up + up - down);
    println!("{stats:?}");
}

#[test]
fn after_a_rebind_the_server_sees_another_address_and_the_client_none() {
    let server = UdpSocket::bind(HERE).unwrap();
    let relay = Relay::start(HERE, server.local_addr().unwrap(), Profile::none(), 1).unwrap();
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
    assert!(matches!(
        relay.rebind(0),
        Err(RebindError::NoFlow { flow: 0, flows: 0 })
    ));
    let before = there_and_back(b"before");
    let address = relay.rebind(0).unwrap();
    let after = there_and_back(b"after");
    assert_ne!(before, after);
    assert_eq!(after.port(), address.port());
    // The old address is gone: what is sent there does not arrive before what is sent later.
    server.send_to(b"too late", before).unwrap();
    there_and_back(b"again");
    let stats = relay.stats();
    assert_eq!((stats.clients, stats.rebinds), (1, 1));
}

#[test]
fn flipped_bits_reach_the_server() {
    let link = Link {
        corrupt: 1.0,
        ..Link::default()
    };
    let mut profile = Profile::none();
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
    assert_eq!(relay.stats().corrupted, 1);
}
