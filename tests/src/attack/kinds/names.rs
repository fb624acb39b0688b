//! Attack with names that look like that of another participant.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{sleep, timeout};

use super::{AGAIN, Target};
use crate::attack::raw_client::{JoinError, RawClient, hello};

/// The name of the honest participant.
const HONEST: &str = "ann";

/// Names that are displayed like [`HONEST`].
const FALSE_NAMES: [&str; 7] = [
    // Zero-width space, zero-width joiner, soft hyphen.
    "ann\u{200b}",
    "a\u{200d}nn",
    "an\u{ad}n",
    // Right-to-left override.
    "\u{202e}nna",
    // Trailing blank, no-break space.
    "ann ",
    "ann\u{a0}",
    // Cyrillic a.
    "\u{430}nn",
];

/// Time between two names.
const NAME_EVERY: Duration = Duration::from_millis(200);

/// Time between two heartbeats of the honest participant, also while an imitator joins. After 2 s of silence the server
/// disconnects it, and the seat of a participant who never moved gives way.
const HEARTBEAT_EVERY: Duration = Duration::from_millis(200);

/// The count of honest participants who lost their connection.
const ENDED: &str = "honest connection lost";

/// The count of false names that the server accepted.
pub(super) const ACCEPTED: &str = "false names accepted";

/// A participant and its imitators, each of which tries once.
pub(super) async fn names(target: Arc<Target>) {
    let link = &target.spectator;
    let mut honest = loop {
        match RawClient::join(link, hello(link, HONEST.to_owned(), None)).await {
            Ok(client) => break client,
            Err(_) => sleep(AGAIN).await,
        }
    };
    for name in FALSE_NAMES {
        let joins = RawClient::join(link, hello(link, name.to_owned(), None));
        let joined = tokio::select! {
            // First: without the honest participant the name is free.
            biased;
            () = stay(&mut honest) => return target.count(ENDED),
            joined = joins => joined,
        };
        target.count(match &joined {
            Ok(_) => ACCEPTED,
            Err(JoinError::Refused(_)) => "false names refused",
            Err(JoinError::Failed(_)) => "joins without an answer",
        });
        if let Ok(client) = joined {
            client.leave().await;
        }
        if timeout(NAME_EVERY, stay(&mut honest)).await.is_ok() {
            return target.count(ENDED);
        }
    }
    stay(&mut honest).await;
    target.count(ENDED);
}

/// Keeps a participant in the session; returns when it has lost its connection.
async fn stay(client: &mut RawClient) {
    loop {
        client.heartbeat();
        if client.drain(HEARTBEAT_EVERY).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{FALSE_NAMES, HONEST};

    #[test]
    fn false_names_differ_from_the_honest_one() {
        assert!(FALSE_NAMES.iter().all(|name| *name != HONEST));
    }
}
