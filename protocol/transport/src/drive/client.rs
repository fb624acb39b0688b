//! A client session in a task.

use std::time::Duration;

use palpate_protocol::request::{Request, RequestKind};
use palpate_protocol::session::{ClientEvent, ClientSession, LinkStats};
use palpate_protocol::{ClientTime, LocalSample, Span};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tracing::Instrument as _;

use crate::connection::Connection;
use crate::drive::{DriverStats, Machine, drive};

/// Commands that may wait: a second of motion.
const COMMANDS_MAX: usize = 256;

/// Events that may wait for the shell; beyond, the session drops motion first.
const EVENTS_MAX: usize = 1024;

/// A command of the shell to the task that drives a client session.
#[derive(Debug)]
pub enum ClientCommand {
    /// New samples of the client's own tool, oldest first. Send them about every 4 ms: four samples make
    /// a datagram, which leaves at once.
    Motion(Vec<LocalSample>),
    /// Sends a request.
    Request(RequestKind),
    /// Sends a request under a number from the caller.
    Numbered(Request),
    /// Leaves the session.
    Leave,
}

/// A client session that runs in a task. Dropping `commands` leaves the session.
pub struct ClientHandle {
    /// Bounded; use `try_send` next to a real-time thread and drop the rest.
    pub commands: mpsc::Sender<ClientCommand>,
    /// Bounded; the last event is [`ClientEvent::Closed`].
    pub events: mpsc::Receiver<ClientEvent>,
    /// Newest figures, about ten times a second.
    pub stats: watch::Receiver<DriverStats>,
    /// Ends when everything is delivered and the connection is closed.
    pub task: JoinHandle<()>,
}

/// Drives a client session in its own task. `clock` is the client's monotonic clock, the one
/// that stamps its samples.
pub fn spawn_client(
    connection: Connection,
    session: ClientSession,
    clock: impl Fn() -> ClientTime + Send + 'static,
) -> ClientHandle {
    let (commands, command_receiver) = mpsc::channel(COMMANDS_MAX);
    let (event_sender, events) = mpsc::channel(EVENTS_MAX);
    let (stats_sender, stats) = watch::channel(DriverStats::default());
    let machine = Client {
        session,
        clock,
        leaves: false,
    };
    let span = tracing::error_span!("connection", remote = %connection.remote_address());
    let driver = drive(
        machine,
        connection,
        command_receiver,
        event_sender,
        stats_sender,
    );
    let task = tokio::spawn(driver.instrument(span));
    ClientHandle {
        commands,
        events,
        stats,
        task,
    }
}

struct Client<C> {
    session: ClientSession,
    clock: C,
    leaves: bool,
}

impl<C: Fn() -> ClientTime + Send> Client<C> {
    fn request(&mut self, kind: RequestKind) {
        if let Err(error) = self.session.request(kind) {
            tracing::warn!(%error, "a request was not sent");
        }
    }
}

impl<C: Fn() -> ClientTime + Send> Machine for Client<C> {
    type Event = ClientEvent;
    type Command = ClientCommand;

    fn handle_stream(&mut self, bytes: &[u8]) {
        self.session.handle_stream(bytes, (self.clock)());
    }

    fn handle_datagram(&mut self, bytes: &[u8], stall: Span) {
        let now = (self.clock)();
        self.session.handle_waiting_datagram(bytes, stall, now);
    }

    fn handle_timeout(&mut self) {
        self.session.handle_timeout((self.clock)());
    }

    fn handle_disconnect(&mut self, why: String) {
        self.session.handle_disconnect(why);
    }

    fn handle_goodbye(&mut self, sentence: String) {
        self.session.handle_goodbye(sentence);
    }

    fn handle_command(&mut self, command: Option<ClientCommand>) {
        self.leaves |= matches!(command, Some(ClientCommand::Leave));
        match command {
            Some(ClientCommand::Motion(samples)) => {
                for sample in samples {
                    self.session.send_motion(sample);
                }
            }
            Some(ClientCommand::Request(kind)) => self.request(kind),
            Some(ClientCommand::Numbered(request)) => {
                if let Err(error) = self.session.send_request(request) {
                    tracing::warn!(%error, "a request was not sent");
                }
            }
            Some(ClientCommand::Leave) | None => {
                if self.session.participant().is_some() {
                    self.request(RequestKind::Leave);
                } else {
                    self.session
                        .handle_disconnect("the participant left".to_owned());
                }
            }
        }
    }

    fn leaves(&self) -> bool {
        self.leaves
    }

    fn poll_stream(&mut self) -> Option<Vec<u8>> {
        self.session.poll_stream()
    }

    fn poll_datagram(&mut self) -> Option<Vec<u8>> {
        self.session.poll_datagram((self.clock)())
    }

    fn poll_event(&mut self) -> Option<ClientEvent> {
        self.session.poll_event()
    }

    fn until_timeout(&self) -> Option<Duration> {
        let wait = self.session.poll_timeout()? - (self.clock)();
        Some(Duration::from_micros(
            u64::try_from(wait.as_micros()).unwrap_or(0),
        ))
    }

    fn is_closed(&self) -> bool {
        self.session.is_closed()
    }

    fn stats(&self) -> LinkStats {
        self.session.stats((self.clock)())
    }
}
