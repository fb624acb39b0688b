//! Fades a force that the haptic loop no longer renews.

/// The rendered fraction of a force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::backend) struct Share {
    /// 0 to 1.
    left: f64,
    /// Number of complete fade-outs. It separates a reported zero from a later one.
    outs: u32,
}

impl Share {
    /// The full force.
    pub(in crate::backend) const FULL: Self = Self { left: 1.0, outs: 0 };

    /// The fraction to render, 0 to 1, of a force whose loop already applied the fraction `known`.
    pub(in crate::backend) fn since(self, known: Self) -> f64 {
        if self.outs != known.outs {
            0.0
        } else if known.left <= self.left {
            1.0
        } else {
            self.left / known.left
        }
    }
}

/// The rendered fraction of a force. It falls when the loop has not renewed the force for some turns, and recovers
/// at the same rate.
///
/// A turn is one exchange with the device: a millisecond for these devices.
///
/// The loop continues from the rendered force once the fraction is reported, so its next orders already contain it.
/// Each order carries the fraction known to its loop; only the loss since then is applied ([`Share::since`]). The
/// fraction recovers only after the loop knows how low it is. The rendered force therefore never changes by more
/// than the loop's own step.
#[derive(Debug, Clone, Copy)]
pub(in crate::backend) struct Fade {
    hold: u32,
    turns: u32,
    missed: u32,
    /// Rendered part of `turns`.
    left: u32,
    outs: u32,
}

impl Fade {
    /// Full for `hold` turns without a new order, then zero within `turns` more.
    pub(in crate::backend) const fn new(hold: u32, turns: u32) -> Self {
        Self {
            hold,
            turns,
            missed: 0,
            left: turns,
            outs: 0,
        }
    }

    /// The fraction to render in this turn, 0 to 1, of a force whose loop already applied the fraction `known`.
    pub(in crate::backend) fn turn(&mut self, is_renewed: bool, known: Share) -> f64 {
        if is_renewed {
            self.missed = 0;
            if self.share().since(known) >= 1.0 {
                self.left = (self.left + 1).min(self.turns);
            }
        } else {
            self.missed = self.missed.saturating_add(1);
            if self.missed > self.hold && self.left > 0 {
                self.left -= 1;
                self.outs = self.outs.wrapping_add(u32::from(self.left == 0));
            }
        }
        self.share().since(known)
    }

    /// The force was removed at once; renewed orders recover as after a fade.
    pub(in crate::backend) const fn cut(&mut self) {
        self.left = 0;
        self.outs = self.outs.wrapping_add(1);
    }

    /// The fraction of the last turn.
    pub(in crate::backend) fn share(&self) -> Share {
        Share {
            left: f64::from(self.left) / f64::from(self.turns),
            outs: self.outs,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{Fade, Share};

    #[test]
    fn a_force_without_renewal_fades_after_hold() {
        let mut fade = Fade::new(20, 20);
        let shares: Vec<f64> = (0..60).map(|_| fade.turn(false, Share::FULL)).collect();
        assert!(shares[..20].iter().all(|s| *s == 1.0));
        assert!(shares[39..].iter().all(|s| *s == 0.0));
    }

    #[test]
    fn an_order_from_before_a_cut_renders_nothing() {
        let mut fade = Fade::new(20, 20);
        fade.cut();
        assert!((0..60).all(|_| fade.turn(false, Share::FULL) == 0.0));
        assert!((0..60).all(|_| fade.turn(true, Share::FULL) == 0.0));
        let first = fade.share();
        assert_eq!(fade.turn(true, first), 1.0);
        // This order knows of the first cut and not of the second.
        fade.cut();
        assert_eq!(fade.turn(true, first), 0.0);
    }

    #[test]
    fn a_known_fraction_recovers_at_the_fade_rate() {
        let mut fade = Fade::new(20, 20);
        while fade.share().left > 0.5 {
            fade.turn(false, Share::FULL);
        }
        assert!((0..60).all(|_| fade.turn(true, Share::FULL) == 0.5));
        let shares: Vec<f64> = (0..10)
            .map(|_| {
                fade.turn(true, fade.share());
                fade.share().left
            })
            .collect();
        assert_eq!((shares[0], shares[9]), (0.55, 1.0));
    }

    proptest! {
        #[test]
        fn no_sequence_of_orders_makes_a_step(device_state in prop::collection::vec(any::<bool>(), 1..300)) {
            let mut fade = Fade::new(3, 10);
            let mut before = 1.0;
            for is_renewed in device_state {
                fade.turn(is_renewed, fade.share());
                let share = fade.share().left;
                prop_assert!((0.0..=1.0).contains(&share));
                prop_assert!((share - before).abs() <= 0.1 + 1e-12);
                before = share;
            }
        }
    }
}
