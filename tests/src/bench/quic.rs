//! Overhead of QUIC for packets of given lengths and send times.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::{Grant, JoinLink, Role};
use palpate_transport::{Connection, PathStats, Server, ServerIdentity, connect};
use tokio::time::{Instant, sleep_until};

use crate::network::{Direction, Profile};
use crate::relay::Relay;
use crate::simulated_session::{Part, Sent};

/// Settling time after the connection is established and after the last packet.
const SETTLE: Duration = Duration::from_millis(500);

const HERE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Added {
    pub(super) bytes: f64,
    pub(super) packets: f64,
}

/// Sends packets again over a connection through a relay; returns the overhead of uplink and downlink.
pub(super) fn send_again(
    sent: &[Sent],
    profile: &Profile,
    seed: u64,
) -> Result<[Added; 2], String> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(|e| format!("cannot start the connection runtime: {e}"))?;
    runtime.block_on(over_a_connection(sent, profile, seed))
}

async fn over_a_connection(
    sent: &[Sent],
    profile: &Profile,
    seed: u64,
) -> Result<[Added; 2], String> {
    let identity = ServerIdentity::generate().map_err(|e| e.to_string())?;
    let server =
        Server::bind(HERE, &identity, Arc::new(|_, _, _| None)).map_err(|e| e.to_string())?;
    let relay = Relay::start(HERE, server.local_addr(), profile.clone(), seed)
        .map_err(|e| format!("the relay could not be started: {e}"))?;
    let link = JoinLink {
        host: relay.local_addr().ip().to_string(),
        port: relay.local_addr().port(),
        role: Role::Trainee,
        certificate: identity.certificate_hash(),
        grant: Grant([0; 16]),
    };
    let mut client = connect(&link).await.map_err(|e| e.to_string())?;
    // The first byte announces a stream to the peer.
    client.write(&[0]).await?;
    let mut peer = server.accept().await.ok_or("the server does not listen")?;
    peer.admit();
    tokio::time::sleep(SETTLE).await;
    let first_us = sent.first().map_or(0, |s| s.at_us);
    let start = Instant::now();
    let of = |direction: Direction| -> Vec<Sent> {
        let one_way = sent.iter().filter(|s| s.direction == direction);
        one_way
            .map(|s| Sent {
                at_us: s.at_us - first_us,
                ..*s
            })
            .collect()
    };
    let last = sent.last().map_or(0, |s| s.at_us - first_us);
    let end = start + Duration::from_micros(last) + SETTLE;
    let up = tokio::spawn(send(client, of(Direction::Up), start, end));
    let down = tokio::spawn(send(peer, of(Direction::Down), start, end));
    let (up, down) = tokio::join!(up, down);
    let both = [up, down].map(|r| r.map_err(|e| format!("a connection's task ended: {e}")));
    server.close("measured").await;
    let [up, down] = both;
    Ok([up??, down??])
}

/// Sends the packets of one side at their times and reads incoming ones until `end`.
async fn send(
    mut connection: Connection,
    packets: Vec<Sent>,
    start: Instant,
    end: Instant,
) -> Result<Added, String> {
    let before = connection.stats();
    let mut given = 0;
    let mut next = packets.iter().peekable();
    loop {
        let due = next
            .peek()
            .map_or(end, |p| start + Duration::from_micros(p.at_us));
        tokio::select! {
            () = sleep_until(due) => {
                let Some(packet) = next.next() else { break };
                let bytes = vec![0; usize::from(packet.bytes)];
                given += bytes.len();
                if packet.part == Part::Operations {
                    write_all(&mut connection, &bytes).await?;
                } else {
                    connection.send_datagram(bytes);
                }
            }
            arrived = connection.read_datagram() => drop(arrived?),
        }
    }
    let after = connection.stats();
    added(&before, &after, given)
}

async fn write_all(connection: &mut Connection, mut bytes: &[u8]) -> Result<(), String> {
    while !bytes.is_empty() {
        let taken = connection.write(bytes).await?;
        bytes = &bytes[taken..];
    }
    Ok(())
}

fn added(before: &PathStats, after: &PathStats, given: usize) -> Result<Added, String> {
    let skipped = after.skipped_datagrams - before.skipped_datagrams;
    if skipped > 0 {
        return Err(format!(
            "the connection skipped {skipped} datagrams: this machine or the network is too slow for the bench; \
             choose a better --profile, or run it while nothing else runs"
        ));
    }
    Ok(Added {
        bytes: (after.sent_bytes - before.sent_bytes) as f64 - given as f64,
        packets: (after.sent_packets - before.sent_packets) as f64,
    })
}
