//! The longest recent round trip to a client, from its acknowledgements.
//!
//! A client can lengthen it only by delaying its own datagrams, or by a little pretended loss. It therefore bounds the
//! delays that the client reports.

use crate::{ServerTime, Span};

/// A round trip is remembered for one to two of these times: at least as long as a delay estimate remembers a burst.
const HALF: Span = Span::from_millis(30_000);

/// The longest round trip of the current and of the previous [`HALF`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct RoundTrip {
    since: Option<ServerTime>,
    halves: [Option<Span>; 2],
}

impl RoundTrip {
    /// Notes a measured round trip.
    pub(super) fn note(&mut self, measured: Option<Span>, now: ServerTime) {
        let Some(measured) = measured else { return };
        let ended = self.since.map(|since| now - since);
        if ended.is_none_or(|ended| ended >= HALF) {
            // After two halves without a measurement nothing is known.
            let last = self.halves[0].filter(|_| ended.is_some_and(|e| e < HALF + HALF));
            self.since = Some(now);
            self.halves = [None, last];
        }
        self.halves[0] = self.halves[0].max(Some(measured));
    }

    /// The longest round trip; `None` before the first measurement.
    pub(super) fn longest(&self) -> Option<Span> {
        self.halves[0].max(self.halves[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn longest_round_trip_is_remembered_for_one_to_two_halves() {
        let mut trips = RoundTrip::default();
        assert_eq!(trips.longest(), None);
        let at = |ms: i64| ServerTime::from_micros(ms * 1000);
        for t in (0..150_000).step_by(200) {
            let measured = if t == 1000 { 300 } else { 20 };
            trips.note(Some(Span::from_millis(measured)), at(t));
            let expected = if (1000..60_000).contains(&t) { 300 } else { 20 };
            assert_eq!(trips.longest(), Some(Span::from_millis(expected)), "{t}");
        }
    }
}
