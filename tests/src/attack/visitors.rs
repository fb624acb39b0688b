//! Honest visitors of a session under attack: an observer that reads the log, and newcomers that try to join.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use palpate_protocol::operation::OperationKind;
use palpate_protocol::request::ServerMessage;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{JoinLink, ParticipantId};
use palpate_transport::{ModelRequest, fetch_model, threads};
use tokio::runtime::Runtime;

use super::raw_client::{RawClient, hello};
use crate::session::{Session, SessionError};

/// Name of the observer.
pub(super) const OBSERVER: &str = "observer";

/// Maximum time of a newcomer from the first packet to the complete model.
pub(super) const GIVES_UP: Duration = Duration::from_secs(6);

/// Time between two heartbeats of a visitor.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// Maximum time for the remaining work of the runtime.
const END_WITHIN: Duration = Duration::from_millis(500);

/// One attempt to join.
#[derive(Debug, Clone)]
pub(super) struct Attempt {
    pub(super) began: Instant,
    /// The time to the complete model, or the reason why there is none; `None` while it lasts.
    pub(super) result: Option<Result<Duration, String>>,
}

/// The log as the observer sees it.
#[derive(Debug, Clone, Default)]
pub(super) struct ObservedLog {
    participants: Vec<(ParticipantId, String)>,
    /// Authors of strokes that cut, each with the number of the stroke.
    cuts: BTreeSet<(ParticipantId, u64)>,
    /// All operations.
    pub(super) operations: u64,
    /// The reason why the observer saw no more of the log.
    pub(super) ended: Option<String>,
}

impl ObservedLog {
    /// Number of strokes that cut, by participants with these names; `None` if the log is incomplete.
    pub(super) fn cuts_by(&self, names: &[&str]) -> Option<u64> {
        if self.ended.is_some() {
            return None;
        }
        let named = |id: &ParticipantId| {
            let of = self.participants.iter().find(|(p, _)| p == id);
            of.is_some_and(|(_, name)| names.contains(&name.as_str()))
        };
        Some(self.cuts.iter().filter(|(id, _)| named(id)).count() as u64)
    }

    fn note(&mut self, message: ServerMessage) {
        let ServerMessage::Operation(operation) = message else {
            return;
        };
        self.operations += 1;
        match operation.kind {
            OperationKind::Joined {
                participant, name, ..
            } => self.participants.push((participant, name)),
            OperationKind::Cut(part) => {
                self.cuts
                    .insert((operation.author, part.number(operation.author)));
            }
            _ => {}
        }
    }
}

/// The visitors of a session, on a thread of their own.
pub(super) struct Visitors {
    runtime: Option<Runtime>,
    /// Links of the newcomers, in turn.
    links: Vec<JoinLink>,
    attempts: Arc<Mutex<Vec<Attempt>>>,
    log: Arc<Mutex<ObservedLog>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A panicked task leaves complete entries behind.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Visitors {
    /// Starts the observer. Where attackers may keep all seats of spectators, which a link allows, newcomers are
    /// trainees.
    pub(super) fn start(session: &Session, takes_seats: bool) -> Result<Self, SessionError> {
        let runtime = threads::background_runtime().map_err(SessionError::Runtime)?;
        let spectator = session.direct_link("spectator")?;
        let mut links = vec![session.direct_link("trainee")?];
        let log = Arc::new(Mutex::new(ObservedLog::default()));
        runtime.spawn(observe(spectator.clone(), Arc::clone(&log)));
        if !takes_seats {
            links.push(spectator);
        }
        Ok(Self {
            runtime: Some(runtime),
            links,
            attempts: Arc::default(),
            log,
        })
    }

    /// Starts an attempt to join: trainees and spectators in turn, each with a new name.
    pub(super) fn attempt(&self) {
        let Some(runtime) = &self.runtime else {
            return;
        };
        let number = {
            let mut attempts = lock(&self.attempts);
            attempts.push(Attempt {
                began: Instant::now(),
                result: None,
            });
            attempts.len() - 1
        };
        let link = self.links[number % self.links.len()].clone();
        let attempts = Arc::clone(&self.attempts);
        runtime.spawn(async move {
            let began = Instant::now();
            let visit = visit(&link, format!("newcomer-{number}"));
            let result = match tokio::time::timeout(GIVES_UP, visit).await {
                Ok(Ok(client)) => {
                    let took = began.elapsed();
                    tokio::spawn(client.leave());
                    Ok(took)
                }
                Ok(Err(why)) => Err(why),
                Err(_) => Err(format!("not complete within {} s", GIVES_UP.as_secs())),
            };
            lock(&attempts)[number].result = Some(result);
        });
    }

    /// All attempts so far.
    pub(super) fn attempts(&self) -> Vec<Attempt> {
        lock(&self.attempts).clone()
    }

    /// The log so far.
    pub(super) fn log(&self) -> ObservedLog {
        lock(&self.log).clone()
    }
}

impl Drop for Visitors {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(END_WITHIN);
        }
    }
}

/// Joins and fetches the model, as a client with an empty cache does.
async fn visit(link: &JoinLink, name: String) -> Result<RawClient, String> {
    let tool = link.role.has_tool().then(|| ToolDescription::probe(0.005));
    let joined = RawClient::join(link, hello(link, name, tool)).await;
    let mut client = joined.map_err(|e| e.to_string())?;
    let info = client.welcome.model;
    let fetching = fetch_model(link, ModelRequest::of(&client.welcome), |_, _| ());
    tokio::pin!(fetching);
    let model = loop {
        tokio::select! {
            fetched = &mut fetching => break fetched.map_err(|e| e.to_string())?,
            read = client.drain(HEARTBEAT) => {
                read?;
                client.heartbeat();
            }
        }
    };
    if model.len() as u64 == info.bytes {
        Ok(client)
    } else {
        Err(format!(
            "the model has {} instead of {} bytes",
            model.len(),
            info.bytes
        ))
    }
}

/// Reads the log until the connection ends.
async fn observe(link: JoinLink, log: Arc<Mutex<ObservedLog>>) {
    let joined = RawClient::join(&link, hello(&link, OBSERVER.to_owned(), None)).await;
    let mut client = match joined {
        Ok(client) => client,
        Err(error) => {
            lock(&log).ended = Some(error.to_string());
            return;
        }
    };
    loop {
        client.heartbeat();
        let until = tokio::time::Instant::now() + HEARTBEAT;
        loop {
            match client.next(until).await {
                Ok(None) => break,
                Ok(Some(ServerMessage::Goodbye { sentence })) => {
                    lock(&log).ended = Some(sentence);
                    return;
                }
                Ok(Some(message)) => lock(&log).note(message),
                Err(why) => {
                    lock(&log).ended = Some(why);
                    return;
                }
            }
        }
    }
}
