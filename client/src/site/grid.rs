//! The common grid of moments: s = k / `tick_hz`, the same at every site.

use palpate_protocol::clock::ClockMap;
use palpate_protocol::{ClientTime, ServerTime, Span};

use super::Site;

/// A map that leads so far back corrects a clock that was set, by hours perhaps; a map that is only made
/// better never leads back at all.
const SET_BACK: Span = Span::from_millis(1000);

impl Site {
    /// The newest map to the server's clock. Between the moment in which one's own clock is set ahead and
    /// the map that knows of it, moments were seen that are yet to come: they count for nothing.
    pub(super) fn take_clock(&mut self, map: ClockMap, now: ClientTime) {
        let before = self.clock.replace(map);
        let is_set_back = before.is_some_and(|b| b.to_server(now) - map.to_server(now) > SET_BACK);
        if is_set_back {
            (self.last_k, self.first_view, self.made_up) = (None, None, None);
            self.resync.restart();
            // Its samples were stamped in that future.
            self.roster.lose(self.me);
        }
    }
}

/// The newest point of the grid that is not after `s`.
pub fn grid_index(s: ServerTime, tick_hz: i64) -> i64 {
    let scaled = i128::from(s.as_micros()) * i128::from(tick_hz);
    // k is so chosen that grid_moment(k) <= s, in spite of its rounding down.
    let k = scaled.div_euclid(1_000_000) as i64;
    if grid_moment(k + 1, tick_hz) <= s {
        k + 1
    } else {
        k
    }
}

/// The moment of a point of the grid, rounded down to the microsecond.
pub fn grid_moment(k: i64, tick_hz: i64) -> ServerTime {
    let us = i128::from(k) * 1_000_000;
    ServerTime::from_micros(us.div_euclid(i128::from(tick_hz)) as i64)
}
