//! The datagrams of a client: motion first, and the rest so that it shares motion's packets.

use super::{ClientSession, State};
use crate::datagram::Body;
use crate::{ClientTime, ServerTime, ToolTrack};

/// Pending datagrams other than motion.
#[derive(Debug, Default)]
pub(super) struct Pending {
    /// A clock probe. It contains its time of departure and is therefore created then.
    pub(super) probe: bool,
    /// A heartbeat: many datagrams are not acknowledged yet.
    pub(super) acknowledgement: bool,
    /// Motion was returned since the last `None`.
    after_motion: bool,
}

impl ClientSession {
    /// The next datagram, with the newest content.
    pub fn poll_datagram(&mut self, now: ClientTime) -> Option<Vec<u8>> {
        self.follow_clock(now);
        self.copies.note(now - ClientTime::ZERO);
        let State::Joined(joined) = &self.state else {
            return None;
        };
        let participant = joined.participant;
        let Some(map) = self.clock.map() else {
            return self.next_of_rest(now, ServerTime::ZERO);
        };
        let generated = map.to_server(now);
        while let Some((samples, late)) = self.motion.poll(now, &map) {
            self.link.count_stall(late.newest);
            let track = ToolTrack {
                participant,
                samples,
                late,
            };
            if let Some(bytes) = self.link.encode(Body::Motion(vec![track]), generated) {
                self.pending.after_motion = true;
                return Some(bytes);
            }
        }
        self.link.count_refused_samples(self.motion.take_stale());
        // The collecting batch leaves within milliseconds and shares its packet with these datagrams.
        // Where a few samples remain in every batch, the other datagrams follow the last one sent.
        let with_motion = std::mem::take(&mut self.pending.after_motion);
        if self.motion.collects() && !with_motion {
            return None;
        }
        let rest = self.next_of_rest(now, generated);
        self.pending.after_motion = with_motion && rest.is_some();
        rest
    }

    /// Queues the copies that are due.
    pub(super) fn enqueue_copies(&mut self, now: ClientTime) {
        let since = self
            .clock
            .map()
            .map_or(ServerTime::ZERO, |map| map.to_server(now));
        while let Some(copy) = self.copies.poll(now - ClientTime::ZERO) {
            self.link.enqueue_copy(copy, since);
        }
    }

    /// The next datagram other than motion.
    fn next_of_rest(&mut self, now: ClientTime, generated: ServerTime) -> Option<Vec<u8>> {
        if std::mem::take(&mut self.pending.probe) {
            let probe = self.clock.probe(now);
            if let Some(bytes) = self.link.encode(Body::Probe(probe), generated) {
                return Some(bytes);
            }
        }
        if std::mem::take(&mut self.pending.acknowledgement) && self.link.owes_acknowledgement() {
            return self.link.encode(Body::Delays(Vec::new()), generated);
        }
        self.link.pop(generated)
    }
}
