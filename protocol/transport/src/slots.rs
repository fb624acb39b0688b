//! The pending connections of a server, and the slot that each of them holds.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use palpate_protocol::Span;
use quinn::{Incoming, VarInt};
use tokio::sync::oneshot;

use crate::admission::{Admission, AdmissionStats, Ticket, Verdict};
use crate::config::ADMITTED_WINDOW;

/// Time between two looks for connections that have exceeded their time.
pub(crate) const CHECK_PERIOD: Duration = Duration::from_millis(100);

/// The reasons for closing, for people. The client may come again.
const EVICTED: &str = "the server has too many unfinished connections; try again";
const TIMED_OUT: &str = "the first message was not complete in time; try again";

/// The server's end of a pending connection, which an eviction closes.
enum Holder {
    /// Dropping it ends the handshake.
    Handshake {
        _ends: oneshot::Sender<()>,
    },
    Connected(quinn::Connection),
}

struct Table {
    admission: Admission,
    holders: HashMap<Ticket, Holder>,
}

/// The table of pending connections; each has a [`Slot`].
pub(crate) struct Slots {
    table: Mutex<Table>,
    began: Instant,
}

/// The answer to an attempt to connect.
pub(crate) enum Attempt {
    Retry,
    Ignore,
    Admitted(Slot),
}

impl Slots {
    pub(crate) fn new() -> Arc<Self> {
        let table = Table {
            admission: Admission::new(Span::ZERO),
            holders: HashMap::new(),
        };
        Arc::new(Self {
            table: Mutex::new(table),
            began: Instant::now(),
        })
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        // Every statement leaves the table consistent.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> Span {
        Span::from_micros(i64::try_from(self.began.elapsed().as_micros()).unwrap_or(i64::MAX))
    }

    /// Decides on an attempt, and closes the connection that it evicts.
    pub(crate) fn attempt(self: &Arc<Self>, from: IpAddr, is_proved: bool) -> Attempt {
        let mut table = self.lock();
        let (ticket, evicted) = match table.admission.handle_attempt(from, is_proved, self.now()) {
            Verdict::Retry => return Attempt::Retry,
            Verdict::Ignore => return Attempt::Ignore,
            Verdict::Admit { ticket, evicted } => (ticket, evicted),
        };
        let evicted = evicted.and_then(|evicted| table.holders.remove(&evicted));
        let (ends, ended) = oneshot::channel();
        table
            .holders
            .insert(ticket, Holder::Handshake { _ends: ends });
        drop(table);
        close(evicted, EVICTED);
        Attempt::Admitted(Slot {
            slots: Arc::clone(self),
            ticket,
            ended,
            quic: None,
        })
    }

    /// Closes the connections that have exceeded their time.
    pub(crate) fn close_overdue(&self) {
        let mut table = self.lock();
        let overdue = table.admission.handle_timeout(self.now());
        let overdue: Vec<Holder> = overdue
            .iter()
            .filter_map(|ticket| table.holders.remove(ticket))
            .collect();
        drop(table);
        close(overdue, TIMED_OUT);
    }

    pub(crate) fn stats(&self) -> AdmissionStats {
        self.lock().admission.stats()
    }
}

fn close(holders: impl IntoIterator<Item = Holder>, why: &str) {
    for holder in holders {
        if let Holder::Connected(quic) = holder {
            quic.close(VarInt::from_u32(0), why.as_bytes());
        }
    }
}

/// The place of one pending connection in the table. It is given up when dropped.
pub(crate) struct Slot {
    slots: Arc<Slots>,
    ticket: Ticket,
    ended: oneshot::Receiver<()>,
    quic: Option<quinn::Connection>,
}

impl Slot {
    /// Completes the handshake; `None` if it fails or the slot is lost.
    pub(crate) async fn shake(&mut self, incoming: Incoming) -> Option<quinn::Connection> {
        let connecting = incoming.accept().ok()?;
        let quic = tokio::select! {
            connected = connecting => connected.ok()?,
            _ = &mut self.ended => return None,
        };
        let mut table = self.slots.lock();
        if !table
            .admission
            .handle_handshake(self.ticket, self.slots.now())
        {
            return None;
        }
        let connected = Holder::Connected(quic.clone());
        table.holders.insert(self.ticket, connected);
        drop(table);
        self.quic = Some(quic.clone());
        Some(quic)
    }

    /// The hello is complete; the room decides.
    pub(crate) fn handle_hello(&self) {
        let mut table = self.slots.lock();
        table.admission.handle_hello(self.ticket, self.slots.now());
    }

    /// Counts a refused request for a model.
    pub(crate) fn count_refused_transfer(&self) {
        self.slots.lock().admission.count_refused_transfer();
    }

    /// The connection is admitted: its time is no longer limited, and it may send more at once.
    pub(crate) fn admit(self) {
        if let Some(quic) = &self.quic {
            quic.set_receive_window(VarInt::from_u32(ADMITTED_WINDOW));
        }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut table = self.slots.lock();
        table.admission.finish(self.ticket);
        let holder = table.holders.remove(&self.ticket);
        drop(table);
        drop(holder);
    }
}
