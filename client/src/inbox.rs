//! What the session told, waiting for the replica.
//!
//! The network task never waits for the replica: it puts events here. What may get lost gets lost
//! first; what must not is bounded so generously that only a replica that stands still reaches it.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use palpate_protocol::session::ClientEvent;

/// With so many events waiting, motion and corrections are dropped: about ten seconds of eight
/// tools, while a model is decoded or a long log is applied.
const LOSSY_MAX: usize = 20_000;

/// Events that may wait at all, about a hundred thousand operations. Beyond, the session is given
/// up, because a hole in the log can not be closed again.
const EVENTS_MAX: usize = 120_000;

/// Events on their way from the network to the replica.
#[derive(Debug, Default)]
pub(crate) struct Inbox {
    events: Mutex<VecDeque<ClientEvent>>,
}

impl Inbox {
    /// Puts an event in; `false` when there is no room for one that must not get lost.
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
        events.push_back(event);
        true
    }

    /// Everything that waits, oldest first.
    pub(crate) fn take(&self) -> VecDeque<ClientEvent> {
        std::mem::take(&mut *self.lock())
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<ClientEvent>> {
        // A queue is whole between any two statements that hold the lock.
        self.events.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::ToolTrack;

    use super::*;

    #[test]
    fn motion_gets_lost_before_operations() {
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
