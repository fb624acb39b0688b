//! The task that drives one peer of a server.
//!
//! One task of the shell owns the room. Every peer's task sends its events into the one bounded inbox of
//! that task. The room reaches every peer through a [`PeerHandle`] that never blocks: a full datagram
//! queue drops datagrams, and a peer with a full reliable queue is closed.
//!
//! Reliable messages wait in that queue while the session has no room, so that few of them are encoded at
//! a time. An operation in the queue is shared by all peers.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use palpate_protocol::session::{LinkStats, PeerDatagram, PeerEvent, PeerMessage, ServerPeer};
use palpate_protocol::{Emulation, ServerTime, Span};
use tokio::sync::{mpsc, watch};
use tracing::Instrument as _;

use crate::connection::{Connection, PathStats};
use crate::drive::emulated_path::{EmulatedPath, Way};
use crate::drive::{Commands, DriverStats, Machine, drive};
use crate::slots::Slot;

/// Capacity of a peer's reliable queue: the longest log that a room sends to a new participant, 26,900
/// operations, and 2,000 messages meanwhile. Beyond it the peer is closed. An entry has at most 64 bytes beside
/// the operation that it shares; a full queue takes 1.9 MB.
pub const RELIABLE_QUEUE_MAX: usize = 28_900;

/// The size of an entry of the queue, bytes.
const ENTRY_BYTES_MAX: usize = 64;
const _: () = assert!(size_of::<PeerMessage>() <= ENTRY_BYTES_MAX);

/// Datagrams that may wait for a peer's task; beyond it they are dropped and counted.
pub const DATAGRAM_QUEUE_MAX: usize = 256;

/// One connection of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerId(pub u64);

/// An event of one peer, for the one task that owns the room.
#[derive(Debug)]
pub struct PeerInput {
    /// The peer.
    pub peer: PeerId,
    /// When it was read from the network.
    pub at: ServerTime,
    /// The event.
    pub event: PeerEvent,
}

/// The room's end of one peer; nothing in it blocks. Dropping it closes the connection.
pub struct PeerHandle {
    id: PeerId,
    reliable: mpsc::Sender<PeerMessage>,
    datagrams: mpsc::Sender<PeerDatagram>,
    overflow: mpsc::Sender<()>,
    emulation: watch::Sender<Emulation>,
    dropped: Arc<AtomicU64>,
    stats: watch::Receiver<DriverStats>,
}

impl PeerHandle {
    /// The peer's number.
    pub fn id(&self) -> PeerId {
        self.id
    }

    /// Sends a reliable message. `false` when the peer is gone or too slow; a slow peer is closed, and a
    /// [`PeerEvent::Closed`] follows.
    pub fn send(&self, message: PeerMessage) -> bool {
        match self.reliable.try_send(message) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Closed(_)) => false,
            Err(mpsc::error::TrySendError::Full(_)) => {
                // One such note is enough.
                let _ = self.overflow.try_send(());
                false
            }
        }
    }

    /// Sends an unreliable message; `false` when it was dropped, which is counted.
    pub fn send_datagram(&self, datagram: PeerDatagram) -> bool {
        let sent = self.datagrams.try_send(datagram).is_ok();
        self.dropped.fetch_add(u64::from(!sent), Ordering::Relaxed);
        sent
    }

    /// Emulates a network between the server and this peer from now on: its delay in both directions, and its loss. The
    /// emulation is in range. The session measures it like a real network, and the [`stats`](Self::stats) contain it.
    ///
    /// Datagrams are dropped; a lost packet of the stream waits for one more emulated round trip. A connection or session
    /// that ends does not wait.
    pub fn emulate(&self, emulation: Emulation) {
        (self.emulation).send_if_modified(|known| std::mem::replace(known, emulation) != emulation);
    }

    /// Newest figures, renewed about ten times a second.
    pub fn stats(&self) -> DriverStats {
        let mut stats = *self.stats.borrow();
        stats.path.skipped_datagrams += self.dropped.load(Ordering::Relaxed);
        stats
    }
}

/// Drives one peer in its own task and sends its events into the one bounded `inbox` of all peers.
/// `clock` is the server's clock.
pub fn spawn_peer(
    mut connection: Connection,
    id: PeerId,
    clock: impl Fn() -> ServerTime + Send + 'static,
    inbox: mpsc::Sender<PeerInput>,
) -> PeerHandle {
    let (reliable, reliable_receiver) = mpsc::channel(RELIABLE_QUEUE_MAX);
    let (datagrams, datagram_receiver) = mpsc::channel(DATAGRAM_QUEUE_MAX);
    let (overflow, overflow_receiver) = mpsc::channel(1);
    let (emulation, emulation_receiver) = watch::channel(Emulation::NONE);
    let (stats_sender, stats) = watch::channel(DriverStats::default());
    let machine = Peer {
        id,
        session: ServerPeer::new(clock()),
        path: EmulatedPath::new(id.0),
        slot: connection.take_slot(),
        clock,
    };
    let source = FromRoom {
        reliable: reliable_receiver,
        datagrams: datagram_receiver,
        overflow: overflow_receiver,
        emulation: emulation_receiver,
    };
    let remote = connection.remote_address();
    let span = tracing::error_span!("connection", peer = id.0, %remote);
    let driver = drive(machine, connection, source, inbox, stats_sender);
    tokio::spawn(driver.instrument(span));
    PeerHandle {
        id,
        reliable,
        datagrams,
        overflow,
        emulation,
        dropped: Arc::default(),
        stats,
    }
}

/// A command of the room to a peer's task.
enum PeerCommand {
    Reliable(PeerMessage),
    Datagram(PeerDatagram),
    Overflow,
    Emulate(Emulation),
}

struct FromRoom {
    reliable: mpsc::Receiver<PeerMessage>,
    datagrams: mpsc::Receiver<PeerDatagram>,
    overflow: mpsc::Receiver<()>,
    emulation: watch::Receiver<Emulation>,
}

impl Commands<PeerCommand> for FromRoom {
    async fn next(&mut self, room: bool) -> Option<PeerCommand> {
        tokio::select! {
            biased;
            Some(()) = self.overflow.recv() => Some(PeerCommand::Overflow),
            Ok(()) = self.emulation.changed() => {
                Some(PeerCommand::Emulate(*self.emulation.borrow_and_update()))
            }
            m = self.reliable.recv(), if room => m.map(PeerCommand::Reliable),
            Some(d) = self.datagrams.recv() => Some(PeerCommand::Datagram(d)),
            // The room has dropped its end; the rest of the reliable queue waits for room.
            else => std::future::pending().await,
        }
    }

    fn try_next(&mut self, room: bool) -> Option<PeerCommand> {
        let reliable = room.then(|| self.reliable.try_recv().ok()).flatten();
        let reliable = reliable.map(PeerCommand::Reliable);
        reliable.or_else(|| self.datagrams.try_recv().ok().map(PeerCommand::Datagram))
    }
}

struct Peer<C> {
    id: PeerId,
    session: ServerPeer,
    /// Between the connection and the session; idle unless the instructor emulates a network.
    path: EmulatedPath,
    /// Held until the welcome.
    slot: Option<Slot>,
    clock: C,
}

impl<C: Fn() -> ServerTime + Send> Peer<C> {
    /// Passes the bytes to the session that the emulated path has delivered by now.
    fn receive_due(&mut self) {
        if self.path.is_idle() {
            return;
        }
        let now = (self.clock)();
        while let Some(bytes) = self.path.poll_stream(Way::Up, now) {
            self.session.handle_stream(&bytes, now);
        }
        while let Some((bytes, stall)) = self.path.poll_datagram(Way::Up, now) {
            self.session.handle_waiting_datagram(&bytes, stall, now);
        }
    }

    fn until(&self, due: ServerTime) -> Duration {
        let wait = due - (self.clock)();
        Duration::from_micros(u64::try_from(wait.as_micros()).unwrap_or(0))
    }

    /// Passes the stream bytes to the session that still were on the emulated path when the connection ended.
    fn receive_rest(&mut self) {
        let now = (self.clock)();
        while let Some(bytes) = self.path.take_stream(Way::Up) {
            self.session.handle_stream(&bytes, now);
        }
    }
}

impl<C: Fn() -> ServerTime + Send> Machine for Peer<C> {
    type Event = PeerInput;
    type Command = PeerCommand;

    fn handle_stream(&mut self, bytes: &[u8]) {
        let now = (self.clock)();
        if self.path.is_idle() {
            self.session.handle_stream(bytes, now);
        } else {
            self.path.push_stream(Way::Up, bytes.to_vec(), now);
        }
    }

    fn handle_datagram(&mut self, bytes: &[u8], stall: Span) {
        let now = (self.clock)();
        if self.path.is_idle() {
            self.session.handle_waiting_datagram(bytes, stall, now);
        } else {
            (self.path).push_datagram(Way::Up, bytes.to_vec(), stall, now);
        }
    }

    fn handle_timeout(&mut self) {
        self.receive_due();
        self.session.handle_timeout((self.clock)());
    }

    fn handle_disconnect(&mut self, why: String) {
        self.receive_rest();
        self.session.handle_disconnect(why);
    }

    fn handle_goodbye(&mut self, _: String) {
        self.receive_rest();
        self.session.handle_goodbye();
    }

    fn leaves(&self) -> bool {
        false
    }

    fn handle_command(&mut self, command: Option<PeerCommand>) {
        let now = (self.clock)();
        let result = match command {
            Some(PeerCommand::Reliable(message)) => self.session.send(&message, now),
            Some(PeerCommand::Datagram(datagram)) => {
                self.session.send_datagram(&datagram, now);
                Ok(())
            }
            Some(PeerCommand::Overflow) => {
                self.session.handle_overflow();
                Ok(())
            }
            Some(PeerCommand::Emulate(emulation)) => {
                self.path.set(emulation);
                Ok(())
            }
            None => self
                .session
                .send(&PeerMessage::Goodbye("the session was closed".into()), now),
        };
        if let Err(error) = result {
            tracing::warn!(%error, "a peer was closed");
        }
        if let Some(slot) = self.slot.take_if(|_| self.session.is_joined()) {
            slot.admit();
        }
    }

    fn poll_stream(&mut self) -> Option<Vec<u8>> {
        if self.path.is_idle() {
            return self.session.poll_stream();
        }
        let now = (self.clock)();
        while self.path.has_room(Way::Down)
            && let Some(bytes) = self.session.poll_stream()
        {
            self.path.push_stream(Way::Down, bytes, now);
        }
        if self.session.is_closed() {
            return self.path.take_stream(Way::Down);
        }
        self.path.poll_stream(Way::Down, now)
    }

    fn poll_datagram(&mut self) -> Option<Vec<u8>> {
        // The driver polls this first in every turn.
        self.receive_due();
        let now = (self.clock)();
        if self.path.is_idle() {
            return self.session.poll_datagram(now);
        }
        while let Some(bytes) = self.session.poll_datagram(now) {
            (self.path).push_datagram(Way::Down, bytes, Span::ZERO, now);
        }
        let (bytes, _) = self.path.poll_datagram(Way::Down, now)?;
        Some(bytes)
    }

    fn poll_event(&mut self) -> Option<PeerInput> {
        let event = self.session.poll_event()?;
        if let (PeerEvent::Hello(_), Some(slot)) = (&event, &self.slot) {
            slot.handle_hello();
        }
        Some(PeerInput {
            peer: self.id,
            at: (self.clock)(),
            event,
        })
    }

    fn until_timeout(&self) -> Option<Duration> {
        let session = self.session.poll_timeout()?;
        let path = [self.path.stream_due(Way::Up), self.path.datagram_due()];
        let due = path.into_iter().flatten().fold(session, ServerTime::min);
        Some(self.until(due))
    }

    fn until_stream(&self) -> Option<Duration> {
        Some(self.until(self.path.stream_due(Way::Down)?))
    }

    fn is_closed(&self) -> bool {
        self.session.is_closed()
    }

    fn has_room(&self) -> bool {
        self.session.has_room()
    }

    fn takes_stream(&self) -> bool {
        self.path.has_room(Way::Up)
    }

    fn stats(&self) -> LinkStats {
        self.session.stats()
    }

    fn path_stats(&self, transport: PathStats) -> PathStats {
        self.path.add_to(transport)
    }
}
