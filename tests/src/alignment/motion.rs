//! Motions of the two hands.

use std::sync::Arc;

use palpate_protocol::Pose;

use crate::hand::{Hand, HandParameters, Random};

/// Endless back-and-forth motion along a recording, which is shorter than a session. A jump from end to
/// start would be unrealistic.
struct ThereAndBack {
    motion: Arc<dyn Hand>,
    /// Start offset in the recording, seconds.
    from_s: f64,
}

impl Hand for ThereAndBack {
    fn at(&self, t_s: f64) -> Pose {
        let length_s = self.motion.length_s();
        let t_s = t_s + self.from_s;
        if !length_s.is_finite() || length_s <= 0.0 {
            return self.motion.at(t_s);
        }
        let round_s = t_s.rem_euclid(2.0 * length_s);
        self.motion.at(round_s.min(2.0 * length_s - round_s))
    }

    fn length_s(&self) -> f64 {
        f64::INFINITY
    }
}

/// Two hands: a recorded motion with offsets half a recording apart, or random motions of 87 mm/s with 0.1
/// mm tremor.
pub(super) fn hands(motion: Option<&Arc<dyn Hand>>, seed: u64) -> [Arc<dyn Hand>; 2] {
    [0_u64, 1].map(|k| -> Arc<dyn Hand> {
        let Some(motion) = motion else {
            return Arc::new(Random::new(
                HandParameters::default(),
                seed.wrapping_mul(2) + k,
            ));
        };
        let length_s = motion.length_s();
        let half_s = if length_s.is_finite() {
            0.5 * length_s
        } else {
            0.0
        };
        Arc::new(ThereAndBack {
            motion: Arc::clone(motion),
            from_s: k as f64 * half_s,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Motion along x at 0.1 m/s for 3 s.
    struct Straight;

    impl Hand for Straight {
        fn at(&self, t_s: f64) -> Pose {
            Pose {
                position_m: [0.1 * t_s.clamp(0.0, 3.0), 0.0, 0.0],
                ..Pose::IDENTITY
            }
        }

        fn length_s(&self) -> f64 {
            3.0
        }
    }

    #[test]
    fn recorded_motion_loops_without_jumps_and_hands_have_different_offsets() {
        let motion: Arc<dyn Hand> = Arc::new(Straight);
        let [first, second] = hands(Some(&motion), 1);
        let x = |hand: &Arc<dyn Hand>, t_s: f64| hand.at(t_s).position_m[0];
        for ms in 0..20_000 {
            let t_s = f64::from(ms) * 1e-3;
            let step = x(&first, t_s + 1e-3) - x(&first, t_s);
            assert!(step.abs() <= 1e-4 + 1e-12, "{step} m at {t_s} s");
        }
        assert!((x(&first, 4.0) - 0.2).abs() < 1e-12);
        assert!((x(&second, 0.0) - 0.15).abs() < 1e-12);
    }
}
