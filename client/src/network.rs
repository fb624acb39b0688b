//! The network thread: gets in, fetches the model, and drives the session to its end.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Resume, Welcome};
use palpate_protocol::session::{ClientEvent, ClientSession, CloseReason};
use palpate_protocol::{JoinLink, ModelHash, Span};
use palpate_transport::threads::{self, ThreadClass};
use palpate_transport::{
    ClientCommand, ClientHandle, DriverStats, TransportError, connect, fetch_model, spawn_client,
};
use tokio::sync::{mpsc as async_mpsc, watch};

use crate::ClientError;
use crate::inbox::Inbox;
use crate::lifeline::{Condition, Farewell, Lifeline};
use crate::realtime::{monotonic_now, sleep_until};
use crate::requests::Requests;
use crate::seat::KeptSeat;

/// Commands that may wait for the network thread: a second of motion.
const COMMANDS_MAX: usize = 256;

/// How soon a wish to stop is noticed.
const STOP_POLL: Duration = Duration::from_millis(50);

/// How long leaving politely may wait for room in the queue of commands.
const LEAVE_PATIENCE: Span = Span::from_millis(500);

/// Between two attempts to leave.
const LEAVE_RETRY: Span = Span::from_millis(5);

/// Before a model is fetched again whose connection was lost.
const FETCH_AGAIN: Duration = Duration::from_millis(500);

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
    /// Takes why the log is wanted from its beginning.
    pub(crate) rejoin: async_mpsc::Sender<String>,
    /// What the session told.
    pub(crate) inbox: Arc<Inbox>,
    /// Newest figures.
    pub(crate) stats: watch::Receiver<DriverStats>,
    /// Whether there is a connection.
    pub(crate) condition: watch::Receiver<Condition>,
    thread: JoinHandle<()>,
    /// Set when the thread ended as it should, after its last event.
    ended: Arc<AtomicBool>,
}

/// Where and how to join.
pub(crate) struct Joining {
    pub(crate) link: JoinLink,
    pub(crate) hello: Hello,
    /// Where the seat is kept beyond this run.
    pub(crate) kept: Option<KeptSeat>,
    /// How long to try to come back when the connection is lost.
    pub(crate) reconnect: Duration,
    pub(crate) stop: Arc<AtomicBool>,
    /// Whether SIGINT and SIGTERM set `stop` from now on.
    pub(crate) catch_signals: bool,
}

struct Opened {
    welcome: Box<Welcome>,
    model: Vec<u8>,
    commands: async_mpsc::Sender<ClientCommand>,
    rejoin: async_mpsc::Sender<String>,
    inbox: Arc<Inbox>,
    stats: watch::Receiver<DriverStats>,
    condition: watch::Receiver<Condition>,
}

impl Network {
    /// Joins: returns when the session stands and the model is here.
    pub(crate) fn open(joining: Joining, progress: Progress) -> Result<Self, ClientError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (tell, told) = mpsc::sync_channel(1);
        let ended = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&ended);
        let thread = threads::spawn(ThreadClass::Network, "network", move || {
            runtime.block_on(async {
                if joining.catch_signals {
                    tokio::spawn(watch_signals(Arc::clone(&joining.stop)));
                }
                live(joining, progress, &tell).await;
            });
            ends.store(true, Ordering::Release);
        })?;
        let opened = told.recv().unwrap_or_else(|_| {
            let sentence = "the network thread ended before its time".to_owned();
            Err(ClientError::EndedWhileJoining(sentence))
        })?;
        Ok(Self {
            welcome: opened.welcome,
            model: opened.model,
            commands: opened.commands,
            rejoin: opened.rejoin,
            inbox: opened.inbox,
            stats: opened.stats,
            condition: opened.condition,
            thread,
            ended,
        })
    }

    /// Whether the thread ended before its time, by a panic.
    pub(crate) fn is_broken(&self) -> bool {
        self.thread.is_finished() && !self.ended.load(Ordering::Acquire)
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
    joining: Joining,
    progress: Progress,
    tell: &mpsc::SyncSender<Result<Opened, ClientError>>,
) {
    let (link, stop) = (&joining.link, &*joining.stop);
    let stopped = || ClientError::EndedWhileJoining("you stopped it".to_owned());
    let (hello, mut kept) = (joining.hello, joining.kept);
    let joined = tokio::select! {
        joined = take_seat(link, &hello, kept.as_mut()) => joined,
        () = until(stop) => Err(stopped()),
    };
    let (handle, welcome) = match joined {
        Ok(joined) => joined,
        // Main has gone when this fails; then nobody is left to be told.
        Err(error) => {
            if let Some(kept) = kept.filter(KeptSeat::is_empty) {
                kept.forget();
            }
            return drop(tell.send(Err(error)));
        }
    };
    let inbox = Arc::new(Inbox::default());
    let _last_word = LastWord(Arc::clone(&inbox));
    let (commands, command_receiver) = async_mpsc::channel(COMMANDS_MAX);
    let (rejoin, rejoin_receiver) = async_mpsc::channel(1);
    let (stats_sender, stats) = watch::channel(DriverStats::default());
    let (condition_sender, condition) = watch::channel(Condition::default());
    let lifeline = Lifeline {
        link,
        hello,
        seat: Resume::after_welcome(&welcome, None),
        patience: joining.reconnect,
        inbox: &inbox,
        commands: command_receiver,
        rejoin: rejoin_receiver,
        requests: Requests::new(welcome.participant).of_run(kept.as_ref().map_or(0, KeptSeat::run)),
        delay: DelaySchedule::new(&welcome.compensation),
        stats: stats_sender,
        condition: condition_sender,
        is_lost: false,
    };
    // The session is kept standing from now on: one that is lost while the model comes is made anew too.
    let session = lifeline.run(handle);
    tokio::pin!(session);
    let fetched = tokio::select! {
        fetched = fetch(link, welcome.model.hash, progress, joining.reconnect) => fetched,
        _ = &mut session => return drop(tell.send(Err(ended(&inbox)))),
        () = until(stop) => Err(stopped()),
    };
    let told = match fetched {
        Ok(model) => Ok(Opened {
            welcome,
            model,
            commands,
            rejoin,
            inbox: Arc::clone(&inbox),
            stats,
            condition,
        }),
        // Without an end for commands the session is left.
        Err(error) => {
            drop(commands);
            Err(error)
        }
    };
    // When nobody is left to be told, what was to be told is dropped, and the session left as well.
    drop(tell.send(told));
    if session.await == Farewell::Final
        && let Some(kept) = kept
    {
        kept.forget();
    }
}

/// Takes the seat of an earlier run that did not end as it should, or else a new one.
async fn take_seat(
    link: &JoinLink,
    hello: &Hello,
    kept: Option<&mut KeptSeat>,
) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let Some(kept) = kept else {
        return join(link, hello.clone(), None).await;
    };
    if let Some(resume) = kept.begin_run() {
        let hello = Hello {
            resume: Some(resume),
            ..hello.clone()
        };
        match join(link, hello, None).await {
            // The seat is gone, or belonged to an earlier session of this host.
            Err(ClientError::Refused(sentence)) => {
                tracing::info!(sentence, "the kept seat is gone");
                kept.clear();
            }
            other => return other,
        }
    }
    let joined = join(link, hello.clone(), None).await?;
    kept.keep(&joined.1);
    Ok(joined)
}

/// Ends the session for the replica when the thread ends by a panic, so that no force is felt of a copy
/// that nobody keeps true any more.
struct LastWord(Arc<Inbox>);

impl Drop for LastWord {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let sentence = "the network thread failed; this is a fault of the program";
            let reason = CloseReason::ConnectionLost(sentence.to_owned());
            self.0.push(ClientEvent::Closed(reason));
        }
    }
}

/// Why a session ended while the model came.
fn ended(inbox: &Inbox) -> ClientError {
    let why = match inbox.take().pop_back() {
        Some(ClientEvent::Closed(reason)) => reason.to_string(),
        _ => "the session ended".to_owned(),
    };
    ClientError::EndedWhileJoining(why)
}

/// Connects and is let in; who comes back with the artificial delay as it was known.
pub(crate) async fn join(
    link: &JoinLink,
    hello: Hello,
    delay: Option<DelaySchedule>,
) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let connection = connect(link).await?;
    let mut session = ClientSession::new(hello, monotonic_now())?;
    if let Some(delay) = delay {
        session.go_on_with(delay);
    }
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

/// Fetches the model, again and again while connections are lost and `patience` lasts.
async fn fetch(
    link: &JoinLink,
    expected: ModelHash,
    mut progress: Progress,
    patience: Duration,
) -> Result<Vec<u8>, ClientError> {
    let give_up = tokio::time::Instant::now() + patience;
    let bytes = loop {
        match fetch_model(link, expected, &mut progress).await {
            Ok(bytes) => break bytes,
            Err(error @ (TransportError::Lost { .. } | TransportError::NoAnswer { .. }))
                if tokio::time::Instant::now() < give_up =>
            {
                tracing::info!(%error, "the model is fetched again");
                tokio::time::sleep(FETCH_AGAIN).await;
            }
            Err(error) => return Err(error.into()),
        }
    };
    let found = ModelHash(xxhash_rust::xxh3::xxh3_64(&bytes));
    if found == expected {
        Ok(bytes)
    } else {
        Err(ClientError::ModelDamaged { expected, found })
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_network_that_fails_ends_the_session_and_one_that_ends_says_nothing() {
        let inbox = Arc::new(Inbox::default());
        drop(LastWord(Arc::clone(&inbox)));
        assert!(inbox.take().is_empty());
        let word = LastWord(Arc::clone(&inbox));
        let failed = std::thread::spawn(move || {
            let _word = word;
            panic!("a test");
        });
        assert!(failed.join().is_err());
        assert!(matches!(
            inbox.take().pop_back(),
            Some(ClientEvent::Closed(CloseReason::ConnectionLost(_)))
        ));
    }
}
