//! Attacks of many spectators.

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::datagram::{Body, Probe};
use palpate_protocol::request::RequestKind;
use palpate_protocol::{ClientTime, TopologyHash};
use tokio::time::sleep;

use super::reports::WANTED;
use super::{Target, at_once};
use crate::attack::raw_client::{RawClient, hello};

/// Attackers.
const CROWD: usize = 100;

/// Pause of a refused attacker: all attackers make 50 attempts per second.
const REFUSED: Duration = Duration::from_secs(2);

/// Time that an attacker stays, and the time between its messages.
const STAY: Duration = Duration::from_secs(5);
const MESSAGE_EVERY: Duration = Duration::from_millis(20);

/// Spectators of the flood, the time between their bursts, and datagrams in a burst.
const FLOODERS: usize = 4;
const BURST_EVERY: Duration = Duration::from_millis(5);
const BURST: usize = 40;

/// Bytes of a meaningless datagram.
const NOISE_BYTES: usize = 60;

/// Attackers that hold a valid link and do all that a spectator can.
pub(super) async fn spectators(target: Arc<Target>) {
    at_once(CROWD, |i| {
        let target = Arc::clone(&target);
        async move {
            sleep(REFUSED * i as u32 / CROWD as u32).await;
            for round in 0_u64.. {
                let name = format!("spectator-{i}-{round}");
                let joined =
                    RawClient::join(&target.spectator, hello(&target.spectator, name, None)).await;
                target.count_join(&joined);
                match joined {
                    Ok(client) => stay(client, i + round as usize).await,
                    Err(_) => sleep(REFUSED).await,
                }
            }
        }
    })
    .await;
}

/// One of the behaviours, until the connection is dropped.
async fn stay(mut client: RawClient, behaviour: usize) {
    let messages = STAY.as_millis() / MESSAGE_EVERY.as_millis();
    for i in 0..messages as u64 {
        match behaviour % 4 {
            // Drops at once.
            0 => return,
            1 => {
                client.report(WANTED);
            }
            2 => {
                client.send(probe(i));
            }
            // Never reads the answers.
            _ => {
                let version = i as u32;
                let hash = TopologyHash(i);
                let report = RequestKind::TopologyReport { version, hash };
                if client.request(report).await.is_err() {
                    return;
                }
                sleep(MESSAGE_EVERY).await;
                continue;
            }
        }
        if client.drain(MESSAGE_EVERY).await.is_err() {
            return;
        }
    }
}

fn probe(id: u64) -> Body {
    Body::Probe(Probe {
        id: id as u32,
        client_sent: ClientTime::from_micros(id as i64),
    })
}

/// Spectators that send datagrams up to the caps of the transport, half of them meaningless.
pub(super) async fn flood(target: Arc<Target>) {
    at_once(FLOODERS, |i| {
        let target = Arc::clone(&target);
        async move {
            loop {
                let hello = hello(&target.spectator, format!("flood-{i}"), None);
                let joined = RawClient::join(&target.spectator, hello).await;
                target.count_join(&joined);
                if let Ok(mut client) = joined {
                    while client.drain(BURST_EVERY).await.is_ok() {
                        let mut sent = 0;
                        for n in 0..BURST {
                            sent += u64::from(if n.is_multiple_of(2) {
                                client.send(probe(n as u64))
                            } else {
                                client.send_bytes(vec![n as u8; NOISE_BYTES])
                            });
                        }
                        target.add("datagrams sent", sent);
                    }
                    target.count("connections ended by the server");
                }
                sleep(REFUSED).await;
            }
        }
    })
    .await;
}
