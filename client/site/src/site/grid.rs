//! The common time grid: s = k / `tick_hz`, the same at every site.

use palpate_protocol::clock::ClockMap;
use palpate_protocol::{ClientTime, ServerTime, Span};

use super::Site;

/// Backward step of the clock map that indicates a clock that was set, perhaps by hours. A refined estimate never
/// steps back this far.
const SET_BACK: Span = Span::from_millis(1000);

impl Site {
    /// Takes the newest clock map to the server. If the client's clock was set ahead, views of the future were shown
    /// until this map arrived; their state is reset.
    pub(super) fn take_clock(&mut self, map: ClockMap, now: ClientTime) {
        let before = self.clock.replace(map);
        let is_set_back = before.is_some_and(|b| b.to_server(now) - map.to_server(now) > SET_BACK);
        if is_set_back {
            (self.last_k, self.first_view, self.extrapolated) = (None, None, None);
            self.resync_policy.restart();
            // Its samples were stamped in the future.
            self.roster.lose(self.me);
        }
    }
}

/// The newest grid index at or before `s`.
pub fn grid_index(s: ServerTime, tick_hz: i64) -> i64 {
    let scaled = i128::from(s.as_micros()) * i128::from(tick_hz);
    // The choice of k gives grid_time(k) <= s despite rounding down.
    let k = scaled.div_euclid(1_000_000) as i64;
    if grid_time(k + 1, tick_hz) <= s {
        k + 1
    } else {
        k
    }
}

/// The time of a grid index, rounded down to the microsecond.
pub fn grid_time(k: i64, tick_hz: i64) -> ServerTime {
    let us = i128::from(k) * 1_000_000;
    ServerTime::from_micros(us.div_euclid(i128::from(tick_hz)) as i64)
}
