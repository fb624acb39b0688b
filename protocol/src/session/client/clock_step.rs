//! Recovery of a session whose own clock is set, by hours or by days.
//!
//! Due times lie at most two periods ahead. A clock that is set back would leave them far ahead: no probe
//! and no report would be sent until then, and the clock map would stay wrong.

use super::{ClientSession, DELAY_REPORT_PERIOD, PROBE_PERIOD, State};
use crate::datagram::Reply;
use crate::session::ClientEvent;
use crate::{ClientTime, Span};

/// Due times farther ahead than this mean that the clock was set back; they become due at once.
fn not_beyond(due: ClientTime, period: Span, now: ClientTime) -> ClientTime {
    if due - now > period { now } else { due }
}

impl ClientSession {
    /// Pulls back due times after a clock was set back. Every call with a time begins with it.
    pub(super) fn follow_clock(&mut self, now: ClientTime) {
        self.probe_due = not_beyond(self.probe_due, PROBE_PERIOD + PROBE_PERIOD, now);
        self.report_due = not_beyond(self.report_due, DELAY_REPORT_PERIOD, now);
        // The last arrival is not in the future.
        self.last_received = self.last_received.min(now);
        self.started = self.started.min(now);
        if let State::Joined(joined) = &mut self.state {
            joined.last_motion_at = joined.last_motion_at.min(now);
        }
    }

    /// An answer to a clock probe.
    pub(super) fn handle_reply(&mut self, reply: Reply, now: ClientTime) {
        let steps = self.clock.steps();
        let map = self.clock.handle_reply(reply, now);
        if self.clock.steps() != steps {
            // Ages measured with the wrong map would be remembered for seconds.
            self.delay.restart();
        }
        if let Some(map) = map {
            self.emit(ClientEvent::Clock(map));
        }
    }
}
