//! A tool whose samples are missing for longer than the gap limit G: it slows down, holds, and stops pressing.
//!
//! ```text
//! a = age of the newest sample          v = velocity at a = G
//! position  x(a) = x(G) + v τ (1 - exp(-(a - G)/τ))        τ = min(50 ms, 5 mm / |v|)
//! strength  g(a) = 1 up to 0.5 s, then a smooth step to 0 at 1 s
//! ```
//!
//! The position is the mean of a Gauss-Markov velocity (Singer 1970). Both laws depend on the shared time and the newest
//! sample alone, so that sites with the same samples show the same tool.

use crate::Span;

/// Time constant of the velocity beyond the gap limit. Of 10 to 200 ms, 50 ms and more have the smallest errors.
pub const SLOWING: Span = Span::from_millis(50);

/// Error budget: the largest distance that a tool is shown to move beyond the gap limit, m. A hand that has stopped
/// at the gap limit is missed by no more.
pub const SLOWING_MAX_M: f64 = 5e-3;

/// Age of the newest sample up to which a tool presses in full. A radio handover takes up to 0.6 s, and must not
/// drop held tissue.
pub const PRESSES_UNTIL: Span = Span::from_millis(500);

/// Age from which it presses no more.
pub const RELEASED_FROM: Span = Span::from_millis(1000);

/// Motion of a tool since the gap limit.
pub(super) struct Slowing {
    /// Distance in seconds of its velocity at the limit.
    pub(super) distance_s: f64,
    /// Present velocity relative to that.
    pub(super) velocity: f64,
}

/// Slow-down of a tool with this speed in m/s at the gap limit.
pub(super) fn slowing(since: Span, speed: f64) -> Slowing {
    let tau = SLOWING.as_secs_f64().min(SLOWING_MAX_M / speed.max(1e-9));
    let velocity = (-since.as_secs_f64() / tau).exp();
    Slowing {
        distance_s: tau * (1.0 - velocity),
        velocity,
    }
}

/// Share of the contact force of a tool whose newest sample has this age.
pub(super) fn strength(age: Span) -> f64 {
    let fade = RELEASED_FROM - PRESSES_UNTIL;
    let left = ((RELEASED_FROM - age).as_secs_f64() / fade.as_secs_f64()).clamp(0.0, 1.0);
    left * left * (3.0 - 2.0 * left)
}
