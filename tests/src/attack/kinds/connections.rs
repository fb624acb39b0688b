//! Attacks before a session: unfinished model transfers and handshakes.

use std::sync::Arc;
use std::time::Duration;

use palpate_transport::connect_bulk;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep};

use super::half_open::{Progress, half_open};
use super::{AGAIN, Target, at_once};

/// Time between two half-open handshakes.
const HANDSHAKE_EVERY: Duration = Duration::from_millis(10);

/// Time that a half-open handshake keeps its port. The server waits longer.
const HANDSHAKE_KEPT: Duration = Duration::from_secs(1);

/// Half-open handshakes at the same time; beyond it the attack pauses.
const HANDSHAKES_MAX: usize = 150;

/// Connections that begin a model transfer and never complete the request.
pub(super) async fn transfers(target: Arc<Target>, n: usize) {
    at_once(n, |i| {
        let target = Arc::clone(&target);
        async move {
            // Connections of one instant would only measure the handshakes.
            sleep(Duration::from_millis(5) * i as u32).await;
            loop {
                match connect_bulk(&target.spectator).await {
                    Ok(mut connection) => {
                        if connection.write(&[0]).await.is_ok() {
                            target.count("transfers begun");
                        }
                        let mut buffer = [0; 64];
                        while let Ok(Some(_)) = connection.read(&mut buffer).await {}
                        target.count("transfers ended by the server");
                    }
                    Err(_) => target.count("connections failed"),
                }
                sleep(AGAIN).await;
            }
        }
    })
    .await;
}

/// Handshakes that never end.
pub(super) async fn handshakes(target: Arc<Target>) {
    let mut due = interval(HANDSHAKE_EVERY);
    due.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut open = JoinSet::new();
    loop {
        due.tick().await;
        while open.try_join_next().is_some() {}
        if open.len() >= HANDSHAKES_MAX {
            continue;
        }
        let target = Arc::clone(&target);
        open.spawn(async move {
            let until = Instant::now() + HANDSHAKE_KEPT;
            target.count(match half_open(&target.spectator, until).await {
                Ok(Progress::Begun) => "handshakes begun",
                Ok(Progress::Asked | Progress::Proven) => "handshakes with a proven address",
                Ok(Progress::Closed) | Err(_) => "handshakes failed",
            });
        });
    }
}
