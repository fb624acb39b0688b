//! The round trip to a page, from WebSocket pings, which a browser answers by itself, or as QUIC measures it.

use palpate_protocol::Span;

/// Two windows of this length hold the last half minute.
const WINDOW: Span = Span::from_millis(15_000);

/// Larger values are no round trip, but a page that makes one up.
const ROUND_TRIP_MAX: Span = Span::from_millis(10_000);

/// The longest round trip of the last half minute.
#[derive(Debug, Default)]
pub(crate) struct RoundTrip {
    /// Beginning of the present window.
    began: Span,
    present: Option<Span>,
    before: Option<Span>,
}

impl RoundTrip {
    /// Handles the answer to a ping. Its content is the time of sending in µs; both times count from the opening of the
    /// connection. Other answers are ignored.
    pub(crate) fn note_answer(&mut self, content: &[u8], now: Span) {
        let Ok(sent_us) = <[u8; 8]>::try_from(content) else {
            return;
        };
        self.note(now - Span::from_micros(i64::from_le_bytes(sent_us)), now);
    }

    /// Handles a measured round trip.
    pub(crate) fn note(&mut self, trip: Span, now: Span) {
        if !(Span::ZERO..=ROUND_TRIP_MAX).contains(&trip) {
            return;
        }
        if now - self.began > WINDOW {
            self.before = self.present.take();
            self.began = now;
        }
        self.present = self.present.max(Some(trip));
    }

    /// See [`RoundTrip`]; `None` before the first answer.
    pub(crate) fn longest(&self) -> Option<Span> {
        self.present.max(self.before)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn longest_round_trip_is_forgotten_after_half_a_minute() {
        let mut trips = RoundTrip::default();
        let mut answer = |sent_ms: i64, ms: i64| {
            let now = Span::from_millis(sent_ms + ms);
            trips.note_answer(&(1000 * sent_ms).to_le_bytes(), now);
            trips.longest().map(|t| t.as_millis_f64() as i64)
        };
        assert_eq!(answer(0, 80), Some(80));
        assert_eq!(answer(1000, 20), Some(80));
        assert_eq!(
            answer(5_000_000, -20),
            Some(80),
            "an answer before its question"
        );
        assert_eq!(answer(20_000, 20), Some(80));
        assert_eq!(answer(40_000, 20), Some(20));
    }
}
