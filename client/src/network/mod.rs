//! The network thread: joins, fetches the model, and drives the session to its end.

mod connection;
mod inbox;
mod motion;
mod retry;
mod seat_file;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Welcome};
use palpate_protocol::session::{ClientEvent, ClientSession, CloseReason};
use palpate_protocol::{JoinLink, ModelHash, Span};
use palpate_site::{ConnectionStatus, Reconnector};
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
use retry::{Retries, random_seed};

pub(crate) use inbox::Inbox;
pub(crate) use motion::MotionThread;
pub(crate) use retry::RetryReport;
pub(crate) use seat_file::SeatFile;

/// Commands queued for the network thread: one second of motion.
const COMMANDS_MAX: usize = 256;

/// Polling period of the stop flag.
const STOP_POLL: Duration = Duration::from_millis(50);

/// Maximum time that leaving waits for room in the command queue.
const LEAVE_PATIENCE: Span = Span::from_millis(500);

/// Retry period of leaving.
const LEAVE_RETRY: Span = Span::from_millis(5);

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
    /// How long to try again when the server is busy or not reached, also after a lost connection.
    pub(crate) reconnect: Duration,
    pub(crate) report: RetryReport,
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
    let (hello, mut seat, mut report) = (joining.hello, joining.seat, joining.report);
    let patience = Span::from_micros(joining.reconnect.as_micros() as i64);
    let retries = Retries::new(patience, &mut report);
    let joined = tokio::select! {
        joined = take_seat(link, &hello, seat.as_mut(), retries) => joined,
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
    let run = seat.as_ref().map_or(0, SeatFile::run);
    let session = Connection {
        link,
        reconnector: Reconnector::new(hello, &welcome, patience, run, random_seed()),
        seat,
        inbox: &inbox,
        commands: command_receiver,
        resync: resync_receiver,
        stats: stats_sender,
        status: status_sender,
    };
    // From here on a connection that is lost during the download is also resumed.
    let session = session.run(handle);
    tokio::pin!(session);
    let retries = Retries::new(patience, &mut report);
    let fetched = tokio::select! {
        fetched = fetch(link, ModelRequest::of(&welcome), progress, retries) => fetched,
        () = &mut session => return drop(sender.send(Err(ended(&inbox)))),
        () = until(stop) => Err(stopped()),
    };
    let outcome = match fetched {
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
    drop(sender.send(outcome));
    session.await;
}

/// Resumes the seat of an earlier run that crashed, or takes a new one.
async fn take_seat(
    link: &JoinLink,
    hello: &Hello,
    mut seat: Option<&mut SeatFile>,
    mut retries: Retries<'_>,
) -> Result<(ClientHandle, Box<Welcome>), ClientError> {
    let mut hello = Hello {
        resume: seat.as_mut().and_then(|seat| seat.begin_run()),
        ..hello.clone()
    };
    loop {
        let error = match join(link, hello.clone(), None).await {
            Ok(joined) => {
                if let Some(seat) = seat {
                    seat.keep(&joined.1);
                }
                return Ok(joined);
            }
            Err(error) => error,
        };
        match error {
            // The seat is gone, or belonged to an earlier session of this host.
            ClientError::Refused(refused)
                if hello.resume.is_some() && !refused.reason.is_temporary() =>
            {
                tracing::info!(refused.sentence, "the kept seat is gone");
                if let Some(seat) = &mut seat {
                    seat.clear();
                }
                hello.resume = None;
            }
            // Two attempts of eight seconds found no server at this address: the link or the network is wrong.
            ClientError::Transport(TransportError::NoAnswer { .. }) if hello.resume.is_none() => {
                return Err(error);
            }
            error => retries.wait_after(error).await?,
        }
    }
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
        CloseReason::Refused(refused) => ClientError::Refused(refused),
        // Before the welcome a goodbye carries the reason for the rejection.
        CloseReason::Goodbye(sentence) => ClientError::Goodbye(sentence),
        reason @ (CloseReason::ConnectionLost(_)
        | CloseReason::Silent(_)
        | CloseReason::HandshakeTimeout) => ClientError::LostWhileJoining(reason),
        other => ClientError::EndedWhileJoining(other.to_string()),
    }
}

/// Fetches the model.
async fn fetch(
    link: &JoinLink,
    request: ModelRequest,
    mut progress: FetchProgress,
    mut retries: Retries<'_>,
) -> Result<Vec<u8>, ClientError> {
    let bytes = loop {
        match fetch_model(link, request, &mut progress).await {
            Ok(bytes) => break bytes,
            Err(error) => retries.wait_after(error.into()).await?,
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
