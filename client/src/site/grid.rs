//! The common grid of moments: s = k / `tick_hz`, the same at every site.

use palpate_protocol::ServerTime;

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
