//! The server's clock as a client knows it.

use crate::{ClientTime, ServerTime, Span};

/// From a client's own clock to the server's and back, valid until the next one replaces it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockMap {
    anchor: ClientTime,
    offset_us: f64,
    rate: f64,
    error_bound: Span,
}

impl ClockMap {
    /// The server's time at a moment of one's own.
    pub fn to_server(&self, t: ClientTime) -> ServerTime {
        let since = (t - self.anchor).as_micros() as f64;
        let offset = (self.offset_us + self.rate * since).round() as i64;
        ServerTime::from_micros(t.as_micros().saturating_add(offset))
    }

    /// One's own time at a moment of the server's.
    pub fn to_client(&self, t: ServerTime) -> ClientTime {
        let at_anchor = self.anchor.as_micros() as f64 + self.offset_us;
        let since = (t.as_micros() as f64 - at_anchor) / (1.0 + self.rate);
        ClientTime::from_micros(self.anchor.as_micros().saturating_add(since.round() as i64))
    }

    /// How far the map can be from the truth: half of the round trip that it rests on. A path
    /// that is slower one way than the other can not be told from an offset.
    pub fn error_bound(&self) -> Span {
        self.error_bound
    }
}
