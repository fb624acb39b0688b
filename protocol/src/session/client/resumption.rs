//! The state that a resumed session continues with.

use super::ClientSession;
use crate::compensation::DelaySchedule;
use crate::handshake::Welcome;

impl ClientSession {
    /// Continues with the earlier schedule of D, if the log continues too. A welcome contains only the
    /// current D. A pending change from before the lost connection is not sent again, and D would stay
    /// halfway until the next one.
    pub fn resume_schedule(&mut self, schedule: DelaySchedule) {
        self.resumed_schedule = Some(schedule);
    }

    /// D over time from a welcome on.
    pub(super) fn schedule_after(&mut self, welcome: &Welcome) -> DelaySchedule {
        let known = self.resumed_schedule.take();
        known
            .filter(|_| welcome.first_operation.0 > 0)
            .unwrap_or_else(|| DelaySchedule::new(&welcome.compensation))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec;
    use crate::handshake::Preamble;
    use crate::request::ServerMessage;
    use crate::session::tests::{returning, welcome};
    use crate::{ClientTime, ServerTime, Span};

    #[test]
    fn resumed_session_continues_a_pending_delay_change() {
        let at = |ms: i64| ServerTime::from_micros(ms * 1000);
        let mut known = DelaySchedule::new(&welcome(0, 0).compensation);
        known.handle_change(300_000, at(1000));
        for (first, in_the_end_ms) in [(3, 300), (0, 150)] {
            let mut client = returning(3);
            client.resume_schedule(known.clone());
            let frame = ServerMessage::Welcome(Box::new(welcome(first, 3)));
            client.handle_stream(&Preamble::OURS.to_bytes(), ClientTime::ZERO);
            client.handle_stream(&codec::encode_frame(&frame).unwrap(), ClientTime::ZERO);
            assert_eq!(
                client.delay_at(at(60_000)),
                Span::from_millis(in_the_end_ms),
                "the log from {first}"
            );
        }
    }
}
