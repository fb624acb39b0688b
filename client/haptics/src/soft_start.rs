//! Soft start: force ramps up from zero, so that a hand that begins inside the tissue, or returns after a fault, is
//! not hit.

use palpate_protocol::Span;

/// A gain that rises from 0 to 1 in a fixed time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SoftStart {
    rise: Span,
    gain: f64,
}

impl SoftStart {
    /// From zero to one in `rise`.
    pub(crate) fn new(rise: Span) -> Self {
        Self { rise, gain: 0.0 }
    }

    /// The gain after `dt` more.
    pub(crate) fn advance(&mut self, dt: Span) -> f64 {
        self.gain = (self.gain + dt.as_secs_f64() / self.rise.as_secs_f64()).min(1.0);
        self.gain
    }

    /// Lowers the gain to `gain`, if it is higher.
    pub(crate) fn lower_to(&mut self, gain: f64) {
        self.gain = self.gain.min(gain.max(0.0));
    }

    /// The present gain.
    pub(crate) fn gain(&self) -> f64 {
        self.gain
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Span;

    use super::SoftStart;

    #[test]
    fn full_force_takes_the_whole_ramp_and_lower_to_restarts_it() {
        let mut s = SoftStart::new(Span::from_millis(1000));
        for _ in 0..500 {
            s.advance(Span::from_millis(1));
        }
        assert!((s.gain() - 0.5).abs() < 1e-9);
        for _ in 0..501 {
            s.advance(Span::from_millis(1));
        }
        assert_eq!(s.gain(), 1.0);
        s.lower_to(0.25);
        assert_eq!(s.advance(Span::ZERO), 0.25);
        s.lower_to(0.9);
        assert_eq!(s.gain(), 0.25);
    }
}
