//! What a driver's thread makes of a force that is not renewed.

/// The share of a force that is rendered: it falls when the loop has not renewed the force for some turns, and comes
/// back as slowly.
///
/// A turn is one exchange with the device, which is a millisecond for the devices that are driven like that.
#[derive(Debug, Clone, Copy)]
pub(in crate::backend) struct Fade {
    hold: u32,
    turns: u32,
    missed: u32,
    /// Of `turns`, so many are rendered.
    left: u32,
}

impl Fade {
    /// Full for `hold` turns without news, then zero within `turns` more.
    pub(in crate::backend) const fn new(hold: u32, turns: u32) -> Self {
        Self {
            hold,
            turns,
            missed: 0,
            left: turns,
        }
    }

    /// The share for this turn, 0 to 1.
    pub(in crate::backend) fn turn(&mut self, is_renewed: bool) -> f64 {
        if is_renewed {
            self.missed = 0;
            self.left = (self.left + 1).min(self.turns);
        } else {
            self.missed = self.missed.saturating_add(1);
            if self.missed > self.hold {
                self.left = self.left.saturating_sub(1);
            }
        }
        self.share()
    }

    /// The force was taken away at once; what is renewed from now on comes back as after a fade.
    pub(in crate::backend) const fn cut(&mut self) {
        self.left = 0;
    }

    /// The share of the last turn.
    pub(in crate::backend) fn share(&self) -> f64 {
        f64::from(self.left) / f64::from(self.turns)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::Fade;

    #[test]
    fn a_force_that_nobody_renews_is_gone_after_hold_and_fade_and_never_sooner_than_hold() {
        let mut fade = Fade::new(20, 20);
        let shares: Vec<f64> = (0..60).map(|_| fade.turn(false)).collect();
        assert!(shares[..20].iter().all(|s| *s == 1.0));
        assert!(shares[39..].iter().all(|s| *s == 0.0));
    }

    #[test]
    fn after_a_cut_nothing_comes_back_before_it_is_renewed_and_then_as_slowly_as_after_a_fade() {
        let mut fade = Fade::new(20, 20);
        fade.cut();
        assert!((0..60).all(|_| fade.turn(false) == 0.0));
        let shares: Vec<f64> = (0..20).map(|_| fade.turn(true)).collect();
        assert_eq!((shares[0], shares[19]), (0.05, 1.0));
    }

    proptest! {
        #[test]
        fn no_news_whatever_makes_a_step(news in prop::collection::vec(any::<bool>(), 1..300)) {
            let mut fade = Fade::new(3, 10);
            let mut before = 1.0;
            for is_renewed in news {
                let share = fade.turn(is_renewed);
                prop_assert!((0.0..=1.0).contains(&share));
                prop_assert!((share - before).abs() <= 0.1 + 1e-12);
                before = share;
            }
        }
    }
}
