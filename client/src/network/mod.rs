//! The network thread: joins, fetches the model, and drives the session to its end.

mod connection;
mod inbox;
mod motion;
mod seat_file;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Welcome};
use palpate_protocol::session::{ClientEvent, ClientSession, CloseReason};
use palpate_protocol::{JoinLink, ModelHash, Span};
use palpate_site::{ConnectionStatus, Farewell, Reconnector};
use palpate_transport::threads::{self, ThreadClass};
use palpate_transport::{
    ClientCommand, ClientHandle, DriverStats, ModelRequest, TransportError, connect, fetch_model,
    spawn_client,
};
use tokio::sync::{mpsc as async_mpsc, watch};
use tracing::Instrument as _;

use crate::ClientError;
use crate::realtime::{monotonic_now, sleep_until};
use connection::Connection;

pub(crate) use inbox::Inbox;
pub(crate) use motion::MotionThread;
pub(crate) use seat_file::SeatFile;

/// Commands queued for the network thread: one second of motion.
const COMMANDS_MAX: usize = 256;

/// Polling period of the stop flag.
const STOP_POLL: Duration = Duration::from_millis(50);

/// Maximum time that leaving waits for room in the command queue.
const LEAVE_PATIENCE: Span = Span::from_millis(500);

/// Retry period of leaving.
const LEAVE_RETRY: Span = Span::from_millis(5);

/// Delay before fetching a model again after a lost connection.
const FETCH_AGAIN: Duration = Duration::from_millis(500);

/// Callback for the progress of the model: bytes received, bytes in total.
pub(crate) type FetchProgress = Box<dyn FnMut(u64, u64) + Send>;

/// An established session with its model, and the channels to its thread.
pub(crate) struct Session {
    /// Welcome of the server.
    pub(crate) welcome: Box<Welcome>,
    /// Bytes of the model file; their hash is verified.
    pub(crate) model: Vec<u8>,
    /// Commands to the session.
    pub(crate) commands: async_mpsc::Sender<ClientCommand>,
    /// Accepts the reason for a resync from the whole log.
    pub(crate) resync: async_mpsc::Sender<String>,
    /// Events of the session.
    pub(crate) inbox: Arc<Inbox>,
    /// Newest statistics.
    pub(crate) stats: watch::Receiver<DriverStats>,
    /// State of the connection.
    pub(crate) connection: watch::Receiver<ConnectionStatus>,
}

/// The network thread of a session.
pub(crate) struct Network {
    pub(crate) session: Session,
    thread: JoinHandle<()>,
    /// Set when the thread ends normally, after its last event.
    ended: Arc<AtomicBool>,
}

/// Parameters of joining.
pub(crate) struct Joining {
    pub(crate) link: JoinLink,
    pub(crate) hello: Hello,
    /// File that keeps the seat beyond this run.
    pub(crate) seat: Option<SeatFile>,
    /// How long to try to reconnect.
    pub(crate) reconnect: Duration,
    pub(crate) stop: Arc<AtomicBool>,
    /// Whether SIGINT and SIGTERM set `stop`.
    pub(crate) catch_signals: bool,
}

impl Network {
    /// Joins; returns once the session is established and the model has arrived.
    pub(crate) fn open(joining: Joining, progress: FetchProgress) -> Result<Self, ClientError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let (sender, report) = mpsc::sync_channel(1);
        let ended = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&ended);
        let thread = threads::spawn(ThreadClass::Network, "network", move || {
            let (host, port) = (&joining.link.host, joining.link.port);
            let session = tracing::error_span!("session", host, port);
            let participant = tracing::error_span!(
                parent: &session,
                "participant",
                name = joining.hello.name,
                id = tracing::field::Empty,
            );
            let network = async {
                if joining.catch_signals {
                    tokio::spawn(watch_signals(Arc::clone(&joining.stop)));
                }
                serve(joining, progress, &sender).await;
            };
            runtime.block_on(network.instrument(participant));
            ends.store(true, Ordering::Release);
        })?;
        let session = report.recv().unwrap_or_else(|_| {
            let sentence = "the network thread panicked".to_owned();
            Err(ClientError::EndedWhileJoining(sentence))
        })?;
        Ok(Self {
            session,
            thread,
            ended,
        })
    }

    /// Whether the thread panicked.
    pub(crate) fn is_broken(&self) -> bool {
        self.thread.is_finished() && !self.ended.load(Ordering::Acquire)
    }

    /// Leaves the session with a goodbye, if it is connected, and waits for the thread.
    pub(crate) fn leave(self) -> DriverStats {
        let give_up = monotonic_now() + LEAVE_PATIENCE;
        while let Err(async_mpsc::error::TrySendError::Full(_)) =
            self.session.commands.try_send(ClientCommand::Leave)
        {
            let now = monotonic_now();
            if now >= give_up {
                break;
            }
            sleep_until(now + LEAVE_RETRY);
        }
        drop(self.session.commands);
        if self.thread.join().is_err() {
            tracing::error!("the network thread panicked");
        }
        *self.session.stats.borrow()
    }
}

/// Body of the thread: join, report, serve.
async fn serve(
    joining: Joining,
    progress: FetchProgress,
    sender: &mpsc::SyncSender<Result<Session, ClientError>>,
) {
    let (link, stop) = (&joining.link, &*joining.stop);
    let stopped = || ClientError::EndedWhileJoining("you stopped it".to_owned());
    let (hello, mut seat) = (joining.hello, joining.seat);
    let joined = tokio::select! {
        joined = take_seat(link, &hello, seat.as_mut()) => joined,
        () = until(stop) => Err(stopped()),
    };
    let (handle, welcome) = match joined {
        Ok(joined) => joined,
        // A failure means that the main thread has gone.
        Err(error) => {
            if let Some(seat) = seat.filter(SeatFile::is_empty) {
                seat.remove();
            }
            return drop(sender.send(Err(error)));
        }
    };
    tracing::Span::current().record("id", welcome.participant.0);
    let inbox = Arc::new(Inbox::default());
    let _guard = PanicGuard(Arc::clone(&inbox));
    let (commands, command_receiver) = async_mpsc::channel(COMMANDS_MAX);
    let (resync, resync_receiver) = async_mpsc::channel(1);
    let (stats_sender, stats) = watch::channel(DriverStats::default());
    let (status_sender, connection) = watch::channel(ConnectionStatus::default());
    let patience = Span::from_micros(joining.reconnect.as_micros() as i64);
    let run = seat.as_ref().map_or(0, SeatFile::run);
    let session = Connection {
        link,
        reconnector: Reconnector::new(hello, &welcome, patience, run),
        inbox: &inbox,
        commands: command_receiver,
        resync: resync_receiver,
        stats: stats_sender,
        status: status_sender,
    };
    // From here on a connection that is lost during the download is also resumed.
    let session = session.run(handle);
    tokio::pin!(session);
    let fetched = tokio::select! {
        fetched = fetch(link, ModelRequest::of(&welcome), progress, joining.reconnect) => fetched,
        _ = &mut session => return drop(sender.send(Err(ended(&inbox)))),
        () = until(stop) => Err(stopped()),
    };
    let report = match fetched {
        Ok(model) => Ok(Session {
            welcome,
            model,
            commands,
            resync,
            inbox: Arc::clone(&inbox),
            stats,
            connection,
        }),
        // Closing the command channel leaves the session.
        Err(error) => {
            drop(commands);
            Err(error)
        }
    };
    // Without a main thread the result is dropped and the session left.
    drop(sender.send(report));
    if session.await == Farewell::Final
        && let Some(seat) = seat
    {
        seat.remove();
    }
}

/// Resumes the seat of an earlier run that crashed, or takes a new one.
async fn take_seat(
    link: &JoinLink,
    hello: &Hello,
    seat: Option<&mut SeatFile>,
) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let Some(seat) = seat else {
        return join(link, hello.clone(), None).await;
    };
    if let Some(resume) = seat.begin_run() {
        let hello = Hello {
            resume: Some(resume),
            ..hello.clone()
        };
        match join(link, hello, None).await {
            // The seat is gone, or belonged to an earlier session of this host.
            Err(ClientError::Refused(sentence)) => {
                tracing::info!(sentence, "the kept seat is gone");
                seat.clear();
            }
            other => return other,
        }
    }
    let joined = join(link, hello.clone(), None).await?;
    seat.keep(&joined.1);
    Ok(joined)
}

/// Ends the session for the replica when the thread panics, so that no force of an outdated replica is rendered.
struct PanicGuard(Arc<Inbox>);

impl Drop for PanicGuard {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let sentence = "the network thread panicked; this is a bug in the program";
            let reason = CloseReason::ConnectionLost(sentence.to_owned());
            self.0.push(ClientEvent::Closed(reason));
        }
    }
}

/// Why the session ended during the download.
fn ended(inbox: &Inbox) -> ClientError {
    let why = match inbox.take().pop_back() {
        Some(ClientEvent::Closed(reason)) => reason.to_string(),
        _ => "the session ended".to_owned(),
    };
    ClientError::EndedWhileJoining(why)
}

/// Connects and joins. A resuming participant keeps its artificial delay.
async fn join(
    link: &JoinLink,
    hello: Hello,
    delay: Option<DelaySchedule>,
) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let connection = connect(link).await?;
    let mut session = ClientSession::new(hello, monotonic_now())?;
    if let Some(delay) = delay {
        session.resume_schedule(delay);
    }
    let mut handle = spawn_client(connection, session, monotonic_now);
    loop {
        match handle.events.recv().await {
            Some(ClientEvent::Welcomed(welcome)) => return Ok((handle, welcome)),
            Some(ClientEvent::Closed(reason)) => return Err(not_joined(reason)),
            Some(_) => {}
            None => {
                let sentence = "the connection ended without a reason".to_owned();
                return Err(ClientError::EndedWhileJoining(sentence));
            }
        }
    }
}

fn not_joined(reason: CloseReason) -> ClientError {
    match reason {
        CloseReason::Refused(refused) => ClientError::Refused(refused.sentence),
        // Before the welcome a goodbye carries the reason for the rejection.
        CloseReason::Goodbye(sentence) => ClientError::Refused(sentence),
        other => ClientError::EndedWhileJoining(other.to_string()),
    }
}

/// Fetches the model; retries lost connections until `patience` is over.
async fn fetch(
    link: &JoinLink,
    request: ModelRequest,
    mut progress: FetchProgress,
    patience: Duration,
) -> Result<Vec<u8>, ClientError> {
    let give_up = tokio::time::Instant::now() + patience;
    let bytes = loop {
        match fetch_model(link, request, &mut progress).await {
            Ok(bytes) => break bytes,
            Err(error @ (TransportError::Lost { .. } | TransportError::NoAnswer { .. }))
                if tokio::time::Instant::now() < give_up =>
            {
                tracing::info!(%error, "fetching the model again");
                tokio::time::sleep(FETCH_AGAIN).await;
            }
            Err(error) => return Err(error.into()),
        }
    };
    let (expected, found) = (request.hash, ModelHash(xxhash_rust::xxh3::xxh3_64(&bytes)));
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

/// The first signal requests a clean shutdown, which takes a second or two.
#[cfg(unix)]
async fn watch_signals(stop: Arc<AtomicBool>) {
    use tokio::signal::unix::{SignalKind, signal};
    let (Ok(mut interrupt), Ok(mut terminate)) = (
        signal(SignalKind::interrupt()),
        signal(SignalKind::terminate()),
    ) else {
        tracing::warn!("cannot catch signals; Ctrl-C will not leave the session cleanly");
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
    fn panic_of_network_thread_closes_session() {
        let inbox = Arc::new(Inbox::default());
        drop(PanicGuard(Arc::clone(&inbox)));
        assert!(inbox.take().is_empty());
        let guard = PanicGuard(Arc::clone(&inbox));
        let failed = std::thread::spawn(move || {
            let _guard = guard;
            panic!("a test");
        });
        assert!(failed.join().is_err());
        assert!(matches!(
            inbox.take().pop_back(),
            Some(ClientEvent::Closed(CloseReason::ConnectionLost(_)))
        ));
    }
}
