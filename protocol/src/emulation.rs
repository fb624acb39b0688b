//! A network that the instructor emulates for one participant, for lessons under delay.

use serde::{Deserialize, Serialize};

use crate::Span;

/// Largest emulated one-way delay, ms; more than twice the largest default playout delay.
pub const EMULATED_DELAY_MAX_MS: u16 = 500;

/// Largest emulated loss, per mille; beyond it a session is no longer usable.
pub const EMULATED_LOSS_MAX_PERMILLE: u16 = 300;

/// Delay and loss of an emulated network, equal in both directions. The default emulates nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Emulation {
    /// One-way delay in ms, at most [`EMULATED_DELAY_MAX_MS`].
    pub delay_ms: u16,
    /// Probability that a packet is lost, per mille, at most [`EMULATED_LOSS_MAX_PERMILLE`].
    pub loss_permille: u16,
}

impl Emulation {
    /// Nothing is emulated.
    pub const NONE: Self = Self {
        delay_ms: 0,
        loss_permille: 0,
    };

    /// Whether both numbers are in range.
    pub const fn is_valid(self) -> bool {
        self.delay_ms <= EMULATED_DELAY_MAX_MS && self.loss_permille <= EMULATED_LOSS_MAX_PERMILLE
    }

    /// Whether it emulates nothing.
    pub const fn is_none(self) -> bool {
        self.delay_ms == 0 && self.loss_permille == 0
    }

    /// The one-way delay.
    pub const fn delay(self) -> Span {
        Span::from_millis(self.delay_ms as i64)
    }

    /// The probability that a packet is lost, 0 to 1.
    pub fn loss(self) -> f64 {
        f64::from(self.loss_permille) * 1e-3
    }
}
