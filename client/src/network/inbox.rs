//! Queue of session events for the replica.
//!
//! The network task puts events here and never waits for the replica. Lossy events are dropped first. The bound for
//! reliable events is reached only by a replica that has stalled.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::Thread;

use palpate_protocol::session::ClientEvent;

/// Queue length from which motion and corrections are dropped: about ten seconds of eight tools, while a model is
/// decoded or a long log is applied.
const LOSSY_MAX: usize = 20_000;

/// Maximum queue length, about a hundred thousand operations. Beyond it the session ends, because a gap in the log
/// can not be repaired.
const EVENTS_MAX: usize = 120_000;

/// Events between the network and the replica.
#[derive(Debug, Default)]
pub(crate) struct Inbox {
    events: Mutex<VecDeque<ClientEvent>>,
    reader: OnceLock<Thread>,
}

impl Inbox {
    /// Queues an event; `false` if there is no room for a reliable event.
    pub(crate) fn push(&self, event: ClientEvent) -> bool {
        let mut events = self.lock();
        let may_get_lost = matches!(
            event,
            ClientEvent::Motion(_) | ClientEvent::Corrections(_) | ClientEvent::Delays(_)
        );
        if may_get_lost && events.len() >= LOSSY_MAX {
            return true;
        }
        let is_last = matches!(event, ClientEvent::Closed(_));
        if events.len() >= EVENTS_MAX && !is_last {
            return false;
        }
        let wakes = matches!(event, ClientEvent::Operation(_));
        events.push_back(event);
        drop(events);
        if let Some(reader) = self.reader.get().filter(|_| wakes) {
            reader.unpark();
        }
        true
    }

    /// Makes the calling thread the reader, which operations unpark.
    pub(crate) fn read_here(&self) {
        self.reader.get_or_init(std::thread::current);
    }

    /// All queued events, oldest first.
    pub(crate) fn take(&self) -> VecDeque<ClientEvent> {
        std::mem::take(&mut *self.lock())
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<ClientEvent>> {
        // Every statement leaves the queue consistent.
        self.events.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::operation::{Operation, OperationKind};
    use palpate_protocol::{OperationId, ParticipantId, ServerTime, Span, ToolTrack, TopologyHash};

    use super::*;
    use crate::realtime::{monotonic_now, park_until};

    #[cfg(not(windows))]
    #[test]
    fn operation_wakes_the_reader_and_motion_does_not() {
        let inbox = Inbox::default();
        inbox.read_here();
        inbox.push(ClientEvent::Motion(ToolTrack::default()));
        assert!(!park_until(monotonic_now() + Span::from_millis(5)));
        let participant = ParticipantId(1);
        inbox.push(ClientEvent::Operation(Operation {
            id: OperationId(0),
            at: ServerTime::ZERO,
            author: participant,
            topology_version_before: 0,
            topology_version_after: 0,
            hash_after: TopologyHash(0),
            kind: OperationKind::Disconnected { participant },
        }));
        assert!(park_until(monotonic_now() + Span::from_millis(10_000)));
    }

    #[test]
    fn motion_is_dropped_before_operations() {
        let inbox = Inbox::default();
        for _ in 0..LOSSY_MAX + 5 {
            assert!(inbox.push(ClientEvent::Motion(ToolTrack::default())));
        }
        assert!(inbox.push(ClientEvent::CaughtUp));
        let events = inbox.take();
        assert_eq!(events.len(), LOSSY_MAX + 1);
        assert_eq!(events.back(), Some(&ClientEvent::CaughtUp));
        for _ in 0..EVENTS_MAX {
            assert!(inbox.push(ClientEvent::CaughtUp));
        }
        assert!(!inbox.push(ClientEvent::CaughtUp));
    }
}
