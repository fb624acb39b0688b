//! The loop that drives one session over one connection, the same for both ends.
//!
//! Each turn sends all pending output of the session machine (datagrams first, encoded just in time).
//! The loop then sleeps until the first of: stream bytes, a datagram, room in the stream, room in the
//! events channel, a command, the machine's deadline. Nothing in it blocks the datagrams.
//!
//! Every turn empties the datagram queue, so that a [`StallDetector`] knows how long they may have waited
//! in it.

pub(crate) mod client;
mod emulated_path;
pub(crate) mod peer;

use std::collections::VecDeque;
use std::time::Duration;

use palpate_protocol::Span;
use palpate_protocol::lateness::StallDetector;
use palpate_protocol::session::LinkStats;
use tokio::sync::{mpsc, watch};

use crate::connection::{Connection, PathStats};
use crate::error::is_goodbye;

/// Statistics of a session, from both layers.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DriverStats {
    /// The session's counters.
    pub link: LinkStats,
    /// The transport's counters.
    pub path: PathStats,
}

/// Events taken out of a session ahead of a slow shell; the session bounds the rest.
const EVENTS_AHEAD: usize = 64;

/// Bytes read from the stream at once.
const READ_BYTES: usize = 16 * 1024;

/// Bytes gathered for one write to the stream.
const WRITE_BYTES: usize = 16 * 1024;

/// Datagrams handled before the loop looks at anything else.
const DATAGRAMS_PER_TURN: usize = 64;

/// The figures are renewed this often.
const STATS_PERIOD: Duration = Duration::from_millis(100);

/// How long a closed session may still send: a farewell over a bad network. Without the limit, a peer
/// that reads nothing would keep the task and its queued bytes for good.
const FAREWELL_MAX: Duration = Duration::from_secs(2);

/// A session state machine together with its clock.
pub(crate) trait Machine: Send {
    type Event: Send;
    type Command: Send;
    fn handle_stream(&mut self, bytes: &[u8]);
    /// Handles a datagram that may have waited for `stall`, because this loop stalled.
    fn handle_datagram(&mut self, bytes: &[u8], stall: Span);
    fn handle_timeout(&mut self);
    fn handle_disconnect(&mut self, why: String);
    /// The other side ended the connection for good, by its close code.
    fn handle_goodbye(&mut self, sentence: String);
    /// `None`: the shell has dropped its end.
    fn handle_command(&mut self, command: Option<Self::Command>);
    fn poll_stream(&mut self) -> Option<Vec<u8>>;
    fn poll_datagram(&mut self) -> Option<Vec<u8>>;
    fn poll_event(&mut self) -> Option<Self::Event>;
    /// Until the next timeout; `None` once closed.
    fn until_timeout(&self) -> Option<Duration>;
    /// Until further stream bytes can be polled, in a machine that delays them.
    fn until_stream(&self) -> Option<Duration> {
        None
    }
    fn is_closed(&self) -> bool;
    /// Whether reliable commands can be taken now; they wait otherwise.
    fn has_room(&self) -> bool {
        true
    }
    /// Whether stream bytes can be handled now; they wait in the connection otherwise.
    fn takes_stream(&self) -> bool {
        true
    }
    /// Whether this side ended for good and does not reconnect.
    fn leaves(&self) -> bool;
    fn stats(&self) -> LinkStats;
    /// The transport's counters with those of a path that the machine emulates.
    fn path_stats(&self, transport: PathStats) -> PathStats {
        transport
    }
}

/// Where commands come from; without `room` the reliable ones wait.
pub(crate) trait Commands<C>: Send {
    /// `None` once the shell has dropped its end. Cancelling it loses nothing.
    fn next(&mut self, room: bool) -> impl Future<Output = Option<C>> + Send;
    /// The next command that is already queued.
    fn try_next(&mut self, room: bool) -> Option<C>;
}

/// A client's commands: it always has room, and its machine rejects requests beyond its queue.
impl<C: Send> Commands<C> for mpsc::Receiver<C> {
    async fn next(&mut self, _room: bool) -> Option<C> {
        self.recv().await
    }

    fn try_next(&mut self, _room: bool) -> Option<C> {
        self.try_recv().ok()
    }
}

/// The event that woke the loop.
enum Moved<C> {
    Read(Result<Option<usize>, String>),
    Written(Result<usize, String>),
    Datagram(Result<Vec<u8>, String>),
    Command(Option<C>),
    Room,
    Time,
}

/// Runs until the session is over, its last event delivered and its last bytes sent, as far as
/// [`FAREWELL_MAX`] lasts for them.
pub(crate) async fn drive<M: Machine>(
    mut machine: M,
    mut connection: Connection,
    mut commands: impl Commands<M::Command>,
    events: mpsc::Sender<M::Event>,
    stats: watch::Sender<DriverStats>,
) {
    let datagrams = connection.quic();
    let mut buffer = vec![0; READ_BYTES];
    let mut outgoing: Vec<u8> = Vec::new();
    let mut pending: VecDeque<M::Event> = VecDeque::new();
    let mut has_shell = true;
    let mut stream_is_open = true;
    let mut stats_at = tokio::time::Instant::now();
    let mut closed_at = None;
    let began = tokio::time::Instant::now();
    let mut watch = StallDetector::default();
    loop {
        while let Some(bytes) = machine.poll_datagram() {
            connection.send_datagram(bytes);
        }
        if outgoing.is_empty() {
            fill(&mut outgoing, &mut machine);
        }
        deliver(&mut machine, &mut pending, &events);
        if stats_at.elapsed() >= STATS_PERIOD {
            stats_at = tokio::time::Instant::now();
            stats.send_replace(DriverStats {
                link: machine.stats(),
                path: machine.path_stats(connection.stats()),
            });
        }
        if machine.is_closed() {
            let since = closed_at.get_or_insert_with(tokio::time::Instant::now);
            stream_is_open &= since.elapsed() < FAREWELL_MAX;
        }
        let has_bytes = !outgoing.is_empty() && stream_is_open;
        let has_events = !pending.is_empty() && !events.is_closed();
        if machine.is_closed() && !has_bytes && !has_events {
            break;
        }
        let room = machine.has_room();
        let reads = stream_is_open && !machine.is_closed() && machine.takes_stream();
        let wait = machine.until_timeout().unwrap_or(STATS_PERIOD);
        // Stream bytes that are due wait for the end of a write, which wakes the loop.
        let stream = machine.until_stream().filter(|_| outgoing.is_empty());
        let wait = stream.map_or(wait, |stream| stream.min(wait));
        let wait = watch.waits(since(began), span(wait));
        let wait = Duration::from_micros(wait.as_micros().unsigned_abs());
        let (send, recv) = (&mut connection.send, &mut connection.recv);
        let moved = tokio::select! {
            r = datagrams.read_datagram(), if !machine.is_closed() => {
                Moved::Datagram(r.map(Vec::from).map_err(|e| crate::error::describe_connection_error(&e)))
            }
            r = recv.read(&mut buffer), if reads => {
                Moved::Read(r.map_err(|e| e.to_string()))
            }
            r = send.write(&outgoing), if has_bytes => Moved::Written(r.map_err(|e| e.to_string())),
            c = commands.next(room), if has_shell => Moved::Command(c),
            _ = events.reserve(), if has_events => Moved::Room,
            () = tokio::time::sleep(wait) => Moved::Time,
        };
        watch.wake(since(began));
        // Datagrams first: a timeout must not find a peer silent whose datagrams have arrived.
        let first = match &moved {
            Moved::Datagram(Ok(bytes)) => Some(bytes),
            _ => None,
        };
        if let Some(bytes) = first.filter(|bytes| connection.accepts(bytes.len())) {
            machine.handle_datagram(bytes, watch.handle_datagram(since(began)));
        }
        if !machine.is_closed() {
            let clock = || since(began);
            drain_datagrams(&mut machine, &mut connection, &datagrams, &mut watch, clock).await;
        }
        match moved {
            Moved::Read(Ok(Some(n))) => machine.handle_stream(&buffer[..n]),
            Moved::Read(Ok(None)) => {
                machine.handle_disconnect("the other side ended the stream".to_owned());
            }
            Moved::Written(Ok(n)) => drop(outgoing.drain(..n)),
            Moved::Datagram(Err(why)) | Moved::Read(Err(why)) | Moved::Written(Err(why)) => {
                stream_is_open = false;
                // The connection has a better reason for its end than its stream.
                let reason = datagrams.close_reason();
                let why = reason
                    .as_ref()
                    .map_or(why, crate::error::describe_connection_error);
                if reason.as_ref().is_some_and(is_goodbye) {
                    machine.handle_goodbye(why);
                } else {
                    machine.handle_disconnect(why);
                }
            }
            Moved::Command(command) => {
                has_shell = command.is_some();
                machine.handle_command(command);
                while let Some(command) = commands.try_next(machine.has_room()) {
                    machine.handle_command(Some(command));
                }
            }
            Moved::Datagram(Ok(_)) | Moved::Room => {}
            Moved::Time => machine.handle_timeout(),
        }
    }
    end(machine, connection, &stats).await;
}

/// Publishes the last figures and closes the connection.
async fn end<M: Machine>(machine: M, connection: Connection, stats: &watch::Sender<DriverStats>) {
    stats.send_replace(DriverStats {
        link: machine.stats(),
        path: machine.path_stats(connection.stats()),
    });
    let sentence = "the session is over";
    if machine.leaves() {
        connection.close_for_good(sentence).await;
    } else {
        connection.close(sentence).await;
    }
}

/// Gathers frames, most of which are short: each write costs quinn a buffer of its own.
fn fill<M: Machine>(outgoing: &mut Vec<u8>, machine: &mut M) {
    while outgoing.len() < WRITE_BYTES
        && let Some(frame) = machine.poll_stream()
    {
        outgoing.extend_from_slice(&frame);
    }
}

/// Moves events to the shell while its channel has room.
fn deliver<M: Machine>(
    machine: &mut M,
    pending: &mut VecDeque<M::Event>,
    events: &mpsc::Sender<M::Event>,
) {
    loop {
        while pending.len() < EVENTS_AHEAD {
            let Some(event) = machine.poll_event() else {
                break;
            };
            pending.push_back(event);
        }
        let Some(event) = pending.pop_front() else {
            return;
        };
        match events.try_send(event) {
            Err(mpsc::error::TrySendError::Full(event)) => return pending.push_front(event),
            Ok(()) | Err(mpsc::error::TrySendError::Closed(_)) => {}
        }
    }
}

/// Handles the datagrams that have already arrived.
async fn drain_datagrams<M: Machine>(
    machine: &mut M,
    connection: &mut Connection,
    datagrams: &quinn::Connection,
    watch: &mut StallDetector,
    clock: impl Fn() -> Span,
) {
    for _ in 0..DATAGRAMS_PER_TURN {
        let next = tokio::select! {
            biased;
            r = datagrams.read_datagram() => r.ok(),
            () = std::future::ready(()) => None,
        };
        let Some(bytes) = next else {
            return watch.handle_empty(clock());
        };
        if connection.accepts(bytes.len()) {
            machine.handle_datagram(&bytes, watch.handle_datagram(clock()));
        }
    }
}

/// Time since the loop began, for its [`StallDetector`].
fn since(began: tokio::time::Instant) -> Span {
    span(began.elapsed())
}

fn span(time: Duration) -> Span {
    Span::from_micros(i64::try_from(time.as_micros()).unwrap_or(i64::MAX))
}
