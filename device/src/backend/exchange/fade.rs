//! What a driver's thread makes of a force that is not renewed.

/// How much of a force is left.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::backend) struct Share {
    /// 0 to 1.
    left: f64,
    /// So often there was nothing left. It tells a zero that was heard of from one that came after.
    outs: u32,
}

impl Share {
    /// All of it.
    pub(in crate::backend) const FULL: Self = Self { left: 1.0, outs: 0 };

    /// What is rendered, 0 to 1, of a force whose loop had `heard` of a share and went on from there.
    pub(in crate::backend) fn since(self, heard: Self) -> f64 {
        if self.outs != heard.outs {
            0.0
        } else if heard.left <= self.left {
            1.0
        } else {
            self.left / heard.left
        }
    }
}

/// The share of a force that is rendered: it falls when the loop has not renewed the force for some turns, and comes
/// back as slowly.
///
/// A turn is one exchange with the device, which is a millisecond for the devices that are driven like that.
///
/// The loop goes on from what is rendered as soon as it has heard the share, so what it orders then has the share in it
/// already. Each order says what its loop had heard; of that, only what was lost since is taken away, as
/// [`Share::since`] says, and the share comes back only once the loop has heard how low it is. So nothing that is rendered
/// changes by more than the loop's own step when it is back.
#[derive(Debug, Clone, Copy)]
pub(in crate::backend) struct Fade {
    hold: u32,
    turns: u32,
    missed: u32,
    /// Of `turns`, so many are rendered.
    left: u32,
    outs: u32,
}

impl Fade {
    /// Full for `hold` turns without news, then zero within `turns` more.
    pub(in crate::backend) const fn new(hold: u32, turns: u32) -> Self {
        Self {
            hold,
            turns,
            missed: 0,
            left: turns,
            outs: 0,
        }
    }

    /// What is rendered in this turn, 0 to 1, of a force whose loop had `heard` of a share.
    pub(in crate::backend) fn turn(&mut self, is_renewed: bool, heard: Share) -> f64 {
        if is_renewed {
            self.missed = 0;
            if self.share().since(heard) >= 1.0 {
                self.left = (self.left + 1).min(self.turns);
            }
        } else {
            self.missed = self.missed.saturating_add(1);
            if self.missed > self.hold && self.left > 0 {
                self.left -= 1;
                self.outs = self.outs.wrapping_add(u32::from(self.left == 0));
            }
        }
        self.share().since(heard)
    }

    /// The force was taken away at once; what is renewed from now on comes back as after a fade.
    pub(in crate::backend) const fn cut(&mut self) {
        self.left = 0;
        self.outs = self.outs.wrapping_add(1);
    }

    /// The share of the last turn.
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
    fn a_force_that_nobody_renews_is_gone_after_hold_and_fade_and_never_sooner_than_hold() {
        let mut fade = Fade::new(20, 20);
        let shares: Vec<f64> = (0..60).map(|_| fade.turn(false, Share::FULL)).collect();
        assert!(shares[..20].iter().all(|s| *s == 1.0));
        assert!(shares[39..].iter().all(|s| *s == 0.0));
    }

    #[test]
    fn after_a_cut_nothing_is_rendered_of_what_was_made_without_having_heard_of_it() {
        let mut fade = Fade::new(20, 20);
        fade.cut();
        assert!((0..60).all(|_| fade.turn(false, Share::FULL) == 0.0));
        assert!((0..60).all(|_| fade.turn(true, Share::FULL) == 0.0));
        let first = fade.share();
        assert_eq!(fade.turn(true, first), 1.0);
        // Heard of the first cut and not of the second.
        fade.cut();
        assert_eq!(fade.turn(true, first), 0.0);
    }

    #[test]
    fn a_share_comes_back_as_slowly_as_it_went_once_it_was_heard_of() {
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
        fn no_news_whatever_makes_a_step(news in prop::collection::vec(any::<bool>(), 1..300)) {
            let mut fade = Fade::new(3, 10);
            let mut before = 1.0;
            for is_renewed in news {
                fade.turn(is_renewed, fade.share());
                let share = fade.share().left;
                prop_assert!((0.0..=1.0).contains(&share));
                prop_assert!((share - before).abs() <= 0.1 + 1e-12);
                before = share;
            }
        }
    }
}
