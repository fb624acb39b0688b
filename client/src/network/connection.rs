//! The connection of a session: carries out the actions of the [`Reconnector`] with sockets and the machine's clock.

use std::future::pending;
use std::pin::Pin;
use std::time::Duration;

use palpate_protocol::JoinLink;
use palpate_protocol::handshake::Welcome;
use palpate_site::{Action, ConnectionStatus, Farewell, Reconnector};
use palpate_transport::{ClientCommand, ClientHandle, DriverStats, TransportError};
use tokio::sync::{mpsc, watch};

use super::inbox::Inbox;
use super::{SeatFile, join};
use crate::ClientError;
use crate::realtime::monotonic_now;

type Joined = Result<(ClientHandle, Box<Welcome>), ClientError>;

/// The ends of the channels that outlive a connection.
pub(super) struct Connection<'a> {
    pub(super) link: &'a JoinLink,
    pub(super) reconnector: Reconnector,
    /// File that keeps the seat beyond this run.
    pub(super) seat: Option<SeatFile>,
    pub(super) inbox: &'a Inbox,
    pub(super) commands: mpsc::Receiver<ClientCommand>,
    /// Receives the reason when the site needs a resync from the whole log.
    pub(super) resync: mpsc::Receiver<String>,
    pub(super) stats: watch::Sender<DriverStats>,
    pub(super) status: watch::Sender<ConnectionStatus>,
}

/// The present connection, or the attempt to connect.
#[derive(Default)]
struct Present<'a> {
    handle: Option<ClientHandle>,
    attempt: Option<Pin<Box<dyn Future<Output = Joined> + 'a>>>,
}

impl<'a> Connection<'a> {
    /// Serves the session until it is over. The seat file is removed once the server has released the seat.
    pub(super) async fn run(mut self, handle: ClientHandle) {
        let mut present = Present {
            handle: Some(handle),
            attempt: None,
        };
        loop {
            self.publish_status();
            if let Some(farewell) = self.act(&mut present) {
                if let Some(handle) = present.handle {
                    end(handle).await;
                }
                if farewell == Farewell::Final
                    && let Some(seat) = self.seat
                {
                    seat.remove();
                }
                return;
            }
            self.take_input(&mut present).await;
        }
    }

    fn publish_status(&self) {
        let status = self.reconnector.status();
        self.status.send_if_modified(|published| {
            let is_new = published != status;
            if is_new {
                published.clone_from(status);
            }
            is_new
        });
    }

    /// Carries out all actions. Returns how the session ended, if it has.
    fn act(&mut self, present: &mut Present<'a>) -> Option<Farewell> {
        while let Some(action) = self.reconnector.poll_action() {
            match action {
                Action::Deliver(event) => {
                    if !self.inbox.push(event) {
                        self.reconnector.handle_overflow();
                    }
                }
                Action::Send(request) => {
                    if let Some(handle) = &present.handle {
                        // `has_room` was true, and a new session's queue has room for all repetitions.
                        let _ = handle.commands.try_send(ClientCommand::Numbered(request));
                    }
                }
                Action::Disconnect => {
                    if let Some(handle) = std::mem::take(present).handle {
                        handle.task.abort();
                    }
                }
                Action::Connect(hello, delay) => {
                    tracing::info!(why = ?self.reconnector.status().lost, "reconnecting");
                    present.attempt = Some(Box::pin(join(self.link, *hello, Some(delay))));
                }
                Action::End(farewell) => return Some(farewell),
            }
        }
        None
    }

    /// Waits for an input and passes it to the state machine.
    async fn take_input(&mut self, present: &mut Present<'a>) {
        let due = self.reconnector.poll_timeout();
        let (events, stats) = match &mut present.handle {
            Some(handle) => (Some(&mut handle.events), Some(&mut handle.stats)),
            None => (None, None),
        };
        tokio::select! {
            event = async {
                match events {
                    Some(events) => events.recv().await,
                    None => pending().await,
                }
            } => {
                if let Some(event) = event {
                    self.reconnector.handle_event(event, monotonic_now());
                } else {
                    let why = "the session ended without a reason".to_owned();
                    self.reconnector.handle_lost(why, monotonic_now());
                }
            }
            joined = async {
                match &mut present.attempt {
                    Some(attempt) => attempt.await,
                    None => pending().await,
                }
            } => {
                present.attempt = None;
                present.handle = self.take_joined(joined);
            }
            command = self.commands.recv() => self.take_command(present.handle.as_ref(), command),
            Some(why) = self.resync.recv() => {
                self.reconnector.handle_resync(why, monotonic_now());
            }
            Some(newest) = async {
                match stats {
                    Some(stats) => {
                        stats.changed().await.ok()?;
                        Some(*stats.borrow_and_update())
                    }
                    None => pending().await,
                }
            } => {
                self.stats.send_replace(newest);
            }
            () = async {
                match due {
                    Some(due) => {
                        let us = (due - monotonic_now()).as_micros();
                        tokio::time::sleep(Duration::from_micros(us.max(0).unsigned_abs())).await;
                    }
                    None => pending().await,
                }
            } => self.reconnector.handle_timeout(monotonic_now()),
        }
    }

    fn take_joined(&mut self, joined: Joined) -> Option<ClientHandle> {
        match joined {
            Ok((handle, welcome)) => {
                // A request for the whole log that waits must not outlive a welcome that brings it.
                while let Ok(why) = self.resync.try_recv() {
                    self.reconnector.handle_resync(why, monotonic_now());
                }
                if let Some(seat) = &mut self.seat {
                    seat.keep(&welcome);
                }
                self.reconnector.handle_welcome(welcome, monotonic_now());
                return Some(handle);
            }
            Err(ClientError::Refused(refused)) => {
                self.reconnector.handle_refusal(refused, monotonic_now());
            }
            Err(ClientError::Goodbye(sentence)) => self.reconnector.handle_dead_end(sentence),
            Err(ClientError::Transport(error @ TransportError::WrongCertificate { .. })) => {
                self.reconnector.handle_dead_end(error.to_string());
            }
            Err(error) => {
                self.reconnector
                    .handle_failure(error.to_string(), monotonic_now());
            }
        }
        None
    }

    /// Passes on a command of the participant; `None` when all senders have gone.
    fn take_command(&mut self, handle: Option<&ClientHandle>, command: Option<ClientCommand>) {
        match (command, handle) {
            (None, _) | (Some(ClientCommand::Leave), None) => self.reconnector.handle_leave(),
            (Some(ClientCommand::Request(kind)), handle) => {
                // A connection that is over takes the request; it is repeated on the next one.
                let has_room =
                    handle.is_some_and(|h| h.commands.is_closed() || h.commands.capacity() > 0);
                self.reconnector.handle_request(kind, has_room);
            }
            (Some(command), Some(handle)) => {
                // Late motion is worthless.
                let _ = handle.commands.try_send(command);
            }
            (Some(_), None) => {}
        }
    }
}

/// Dropping the commands leaves the session, if it is still connected.
async fn end(mut handle: ClientHandle) {
    drop(handle.commands);
    handle.events.close();
    if handle.task.await.is_err() {
        tracing::error!("the session task panicked");
    }
}
