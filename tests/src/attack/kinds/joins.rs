//! Attacks with joins and resumptions.

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::handshake::Hello;
use palpate_protocol::tool::ToolDescription;
use tokio::time::sleep;

use super::{AGAIN, Target, at_once};
use crate::attack::raw_client::{JoinError, RawClient, hello};

/// Seats that change their tools, and those that flap.
const TOOL_SEATS: usize = 8;
const FLAPPING_SEATS: usize = 4;

/// Pause between two resumptions with another tool. It bounds the CPU time that the attack takes from the machine.
const TOOL_EVERY: Duration = Duration::from_millis(40);

/// Resumptions of a seat; a server allows about 100.
const RESUMPTIONS: u64 = 99;

/// Time between two resumptions of a flapping seat.
const FLAP_EVERY: Duration = Duration::from_millis(100);

/// Joins in a round and its length.
const ROUND_JOINS: u32 = 16;
const ROUND: Duration = Duration::from_millis(2500);

/// A probe whose radius differs from join to join.
fn tool(n: u64) -> ToolDescription {
    ToolDescription::probe(1e-3 + 1e-5 * (n % 100) as f64)
}

/// A seat that is dropped and resumed over and over: `next` changes the hello before each resumption. Before the
/// server would no longer give the seat back, its owner leaves, and joins under another name.
async fn resume_often(
    target: &Target,
    name: &str,
    pause: Duration,
    next: impl Fn(&mut Hello, u64) + Send,
) {
    for seat in 0_u64.. {
        let mut hello = hello(&target.trainee, format!("{name}-{seat}"), Some(tool(0)));
        let joined = RawClient::join(&target.trainee, hello.clone()).await;
        target.count_join(&joined);
        let Ok(mut client) = joined else {
            sleep(AGAIN).await;
            continue;
        };
        let mut resumptions = 0;
        loop {
            if resumptions == RESUMPTIONS {
                client.leave().await;
                break;
            }
            hello.resume = Some(client.resume());
            drop(client);
            sleep(pause).await;
            resumptions += 1;
            next(&mut hello, resumptions);
            match RawClient::join(&target.trainee, hello.clone()).await {
                Ok(again) => {
                    target.count("resumed");
                    client = again;
                }
                Err(error) => {
                    target.count(match error {
                        JoinError::Refused(_) => "refused to resume",
                        JoinError::Failed(_) => "failed to resume",
                    });
                    sleep(AGAIN).await;
                    break;
                }
            }
        }
    }
}

/// Trainees that change their tool at every resumption.
pub(super) async fn tools(target: Arc<Target>) {
    at_once(TOOL_SEATS, |i| {
        let target = Arc::clone(&target);
        async move {
            let name = format!("tools-{i}");
            resume_often(&target, &name, TOOL_EVERY, |hello, n| {
                hello.tool = Some(tool(n));
            })
            .await;
        }
    })
    .await;
}

/// Trainees that resume their seats over new connections, with the same tool.
pub(super) async fn flapping(target: Arc<Target>) {
    at_once(FLAPPING_SEATS, |i| {
        let target = Arc::clone(&target);
        async move {
            let name = format!("flapping-{i}");
            resume_often(&target, &name, FLAP_EVERY, |_, _| {}).await;
        }
    })
    .await;
}

/// Spectators that join and drop their connection.
pub(super) async fn seats(target: Arc<Target>) {
    for n in 0_u64.. {
        let hello = hello(&target.spectator, format!("seat-{n}"), None);
        let joined = RawClient::join(&target.spectator, hello).await;
        target.count_join(&joined);
        drop(joined);
        sleep(ROUND / ROUND_JOINS).await;
    }
}
