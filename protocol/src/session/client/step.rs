//! What a session does when its own clock is set, by hours or by days.
//!
//! Moments in which something is due lie one period ahead at most. A clock that is set back leaves them
//! far ahead: without this nothing would be asked and nothing reported until they have come again, and
//! the map to the server's clock would stay as wrong as the clock was set.

use super::{ClientSession, DELAY_REPORT_PERIOD, PROBE_PERIOD, State};
use crate::compensation::{DelayEstimator, DelayRule};
use crate::datagram::Reply;
use crate::session::ClientEvent;
use crate::{ClientTime, Span};

/// What is due so much after now at most; farther ahead the clock was set back, and it is due at once.
fn pulled(due: ClientTime, period: Span, now: ClientTime) -> ClientTime {
    if due - now > period { now } else { due }
}

impl ClientSession {
    /// Pulls back what a clock that was set has left ahead. Every call that is given the time begins so.
    pub(super) fn follow_clock(&mut self, now: ClientTime) {
        self.probe_due = pulled(self.probe_due, PROBE_PERIOD, now);
        self.report_due = pulled(self.report_due, DELAY_REPORT_PERIOD, now);
        // Nothing was heard later than now.
        self.heard = self.heard.min(now);
        self.started = self.started.min(now);
        if let State::Joined(joined) = &mut self.state {
            joined.news_at = joined.news_at.min(now);
        }
    }

    /// An answer to a question for the clock.
    pub(super) fn handle_reply(&mut self, reply: Reply, now: ClientTime) {
        let steps = self.clock.steps();
        let map = self.clock.handle_reply(reply, now);
        if self.clock.steps() != steps {
            // Ages that were measured by the map that was wrong would be remembered for seconds.
            self.delay = DelayEstimator::new(DelayRule::default());
        }
        if let Some(map) = map {
            self.emit(ClientEvent::Clock(map));
        }
    }
}
