//! The network thread: gets in, fetches the model, and drives the session to its end.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::handshake::{Hello, Welcome};
use palpate_protocol::session::{ClientEvent, ClientSession, CloseReason};
use palpate_protocol::{JoinLink, ModelHash, Span};
use palpate_transport::{
    ClientCommand, ClientHandle, DriverStats, connect, fetch_model, spawn_client,
};
use tokio::sync::{mpsc as async_mpsc, watch};

use crate::ClientError;
use crate::inbox::Inbox;
use crate::realtime::{monotonic_now, sleep_until};

/// How soon a wish to stop is noticed.
const STOP_POLL: Duration = Duration::from_millis(50);

/// How long leaving politely may wait for room in the queue of commands.
const LEAVE_PATIENCE: Span = Span::from_millis(500);

/// Between two attempts to leave.
const LEAVE_RETRY: Span = Span::from_millis(5);

/// Told how much of the model has arrived: bytes, of bytes.
pub(crate) type Progress = Box<dyn FnMut(u64, u64) + Send>;

/// A session that stands, with the model that it runs on.
pub(crate) struct Network {
    /// What the server said first.
    pub(crate) welcome: Box<Welcome>,
    /// The bytes of the model file, their hash compared.
    pub(crate) model: Vec<u8>,
    /// To the session.
    pub(crate) commands: async_mpsc::Sender<ClientCommand>,
    /// What the session told.
    pub(crate) inbox: Arc<Inbox>,
    /// Newest figures.
    pub(crate) stats: watch::Receiver<DriverStats>,
    thread: JoinHandle<()>,
}

struct Opened {
    welcome: Box<Welcome>,
    model: Vec<u8>,
    commands: async_mpsc::Sender<ClientCommand>,
    inbox: Arc<Inbox>,
    stats: watch::Receiver<DriverStats>,
}

impl Network {
    /// Joins: returns when the session stands and the model is here. With `catch_signals`, SIGINT
    /// and SIGTERM set `stop` from now on.
    pub(crate) fn open(
        link: JoinLink,
        hello: Hello,
        progress: Progress,
        stop: Arc<AtomicBool>,
        catch_signals: bool,
    ) -> Result<Self, ClientError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (tell, told) = mpsc::sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("network".to_owned())
            .spawn(move || {
                runtime.block_on(async {
                    if catch_signals {
                        tokio::spawn(watch_signals(Arc::clone(&stop)));
                    }
                    live(&link, hello, progress, &stop, &tell).await;
                });
            })?;
        let opened = told.recv().unwrap_or_else(|_| {
            let sentence = "the network thread ended before its time".to_owned();
            Err(ClientError::EndedWhileJoining(sentence))
        })?;
        Ok(Self {
            welcome: opened.welcome,
            model: opened.model,
            commands: opened.commands,
            inbox: opened.inbox,
            stats: opened.stats,
            thread,
        })
    }

    /// Leaves politely, if the session still stands, and waits for the thread.
    pub(crate) fn leave(self) -> DriverStats {
        let give_up = monotonic_now() + LEAVE_PATIENCE;
        while let Err(async_mpsc::error::TrySendError::Full(_)) =
            self.commands.try_send(ClientCommand::Leave)
        {
            let now = monotonic_now();
            if now >= give_up {
                break;
            }
            sleep_until(now + LEAVE_RETRY);
        }
        drop(self.commands);
        if self.thread.join().is_err() {
            tracing::error!("the network thread ended by a panic");
        }
        *self.stats.borrow()
    }
}

/// The thread's life: join, tell, pump.
async fn live(
    link: &JoinLink,
    hello: Hello,
    progress: Progress,
    stop: &AtomicBool,
    tell: &mpsc::SyncSender<Result<Opened, ClientError>>,
) {
    let stopped = || ClientError::EndedWhileJoining("you stopped it".to_owned());
    let joining = tokio::select! {
        joined = join(link, hello) => joined,
        () = until(stop) => Err(stopped()),
    };
    let (mut handle, welcome) = match joining {
        Ok(joined) => joined,
        // Main has gone when this fails; then nobody is left to be told.
        Err(error) => return drop(tell.send(Err(error))),
    };
    let inbox = Arc::new(Inbox::default());
    let fetched = {
        let fetching = fetch(link, welcome.model.hash, progress);
        tokio::select! {
            fetched = fetching => fetched,
            why = pump(&mut handle, &inbox) => Err(ClientError::EndedWhileJoining(why)),
            () = until(stop) => Err(stopped()),
        }
    };
    match fetched {
        Ok(model) => {
            let opened = Opened {
                welcome,
                model,
                commands: handle.commands.clone(),
                inbox: Arc::clone(&inbox),
                stats: handle.stats.clone(),
            };
            if tell.send(Ok(opened)).is_ok() {
                pump(&mut handle, &inbox).await;
            }
        }
        Err(error) => drop(tell.send(Err(error))),
    }
    // Dropping the commands leaves the session, if it still stands.
    drop(handle.commands);
    handle.events.close();
    if handle.task.await.is_err() {
        tracing::error!("the task of the session ended by a panic");
    }
}

async fn join(link: &JoinLink, hello: Hello) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let connection = connect(link).await?;
    let session = ClientSession::new(hello, monotonic_now())?;
    let mut handle = spawn_client(connection, session, monotonic_now);
    loop {
        match handle.events.recv().await {
            Some(ClientEvent::Welcomed(welcome)) => return Ok((handle, welcome)),
            Some(ClientEvent::Closed(reason)) => return Err(not_joined(reason)),
            Some(_) => {}
            None => {
                let sentence = "the connection ended without a word".to_owned();
                return Err(ClientError::EndedWhileJoining(sentence));
            }
        }
    }
}

fn not_joined(reason: CloseReason) -> ClientError {
    match reason {
        CloseReason::Refused(refused) => ClientError::Refused(refused.sentence),
        // Before the welcome this is the sentence after a server's preamble.
        CloseReason::Goodbye(sentence) => ClientError::Refused(sentence),
        other => ClientError::EndedWhileJoining(other.to_string()),
    }
}

async fn fetch(
    link: &JoinLink,
    expected: ModelHash,
    progress: Progress,
) -> Result<Vec<u8>, ClientError> {
    let bytes = fetch_model(link, expected, progress).await?;
    let found = ModelHash(xxhash_rust::xxh3::xxh3_64(&bytes));
    if found == expected {
        Ok(bytes)
    } else {
        Err(ClientError::ModelDamaged { expected, found })
    }
}

/// Moves events into the inbox until the session is over; says why it was.
async fn pump(handle: &mut ClientHandle, inbox: &Inbox) -> String {
    while let Some(event) = handle.events.recv().await {
        let ended = match &event {
            ClientEvent::Closed(reason) => Some(reason.to_string()),
            _ => None,
        };
        if !inbox.push(event) {
            let why = "the operations came faster than this machine applies them".to_owned();
            // The last event always finds room.
            inbox.push(ClientEvent::Closed(CloseReason::ConnectionLost(
                why.clone(),
            )));
            return why;
        }
        if let Some(why) = ended {
            return why;
        }
    }
    "the session ended".to_owned()
}

async fn until(stop: &AtomicBool) {
    while !stop.load(Ordering::Acquire) {
        tokio::time::sleep(STOP_POLL).await;
    }
}

/// The first signal asks for a polite end, which takes a second or two.
#[cfg(unix)]
async fn watch_signals(stop: Arc<AtomicBool>) {
    use tokio::signal::unix::{SignalKind, signal};
    let (Ok(mut interrupt), Ok(mut terminate)) = (
        signal(SignalKind::interrupt()),
        signal(SignalKind::terminate()),
    ) else {
        tracing::warn!("signals can not be caught; Ctrl-C will not leave politely");
        return;
    };
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    stop.store(true, Ordering::Release);
}

#[cfg(not(unix))]
async fn watch_signals(stop: Arc<AtomicBool>) {
    if tokio::signal::ctrl_c().await.is_ok() {
        stop.store(true, Ordering::Release);
    }
}
