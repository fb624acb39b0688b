//! The plain limits: stiffness, force, and change of force.

use nalgebra::Vector3;
use palpate_device::DeviceCaps;
use palpate_protocol::Span;

/// The largest stiffness the loop renders, N/m.
///
/// A sampled spring K held for a period T behind a device of damping b is passive while
/// K <= 2 b / T (Colgate and Schenkel 1997). What is stiffer keeps its solved force but is
/// followed with this slope between two solves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StiffnessCap(f64);

impl StiffnessCap {
    /// The smaller of what the device claims and 2 b / T, with `damping_ns_per_m` = b. A device without motors
    /// claims nothing; what it is told of the force is capped by the second alone.
    pub fn new(caps: &DeviceCaps, damping_ns_per_m: f64, period: Span) -> Self {
        let stable = 2.0 * damping_ns_per_m / period.as_secs_f64();
        Self(if caps.dof_out == 0 {
            stable
        } else {
            caps.max_stiffness_n_per_m.min(stable)
        })
    }

    /// The cap, N/m.
    pub fn n_per_m(self) -> f64 {
        self.0
    }

    /// `stiffness` (N/m), capped.
    pub fn apply(self, stiffness: f64) -> f64 {
        stiffness.clamp(0.0, self.0)
    }
}

/// `force` shortened to `limit_n`, and whether it was too long. The direction stays.
pub fn clamp_force(force: Vector3<f64>, limit_n: f64) -> (Vector3<f64>, bool) {
    let n = force.norm();
    if n > limit_n {
        (force * (limit_n / n), true)
    } else {
        (force, false)
    }
}

/// The last stage: what the hand is given never changes by more than a fixed step per tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slew {
    step_n: f64,
    force: Vector3<f64>,
}

impl Slew {
    /// From zero force, at most `step_n` newtons per tick.
    pub fn new(step_n: f64) -> Self {
        Self {
            step_n,
            force: Vector3::zeros(),
        }
    }

    /// The step, N per tick.
    pub fn step_n(&self) -> f64 {
        self.step_n
    }

    /// The force of the last tick, N.
    pub fn force(&self) -> Vector3<f64> {
        self.force
    }

    /// Where [`towards`](Self::towards) would get in this tick, N.
    pub fn peek(&self, target: Vector3<f64>) -> Vector3<f64> {
        let mut ahead = *self;
        ahead.towards(target).0
    }

    /// Goes towards `target` (N); the new force, and whether the step was too long. A target that
    /// is not finite counts as none, for this stage is the last before the hand.
    pub fn towards(&mut self, target: Vector3<f64>) -> (Vector3<f64>, bool) {
        let is_finite = target.iter().all(|c| c.is_finite());
        let target = if is_finite { target } else { Vector3::zeros() };
        let (step, limited) = clamp_force(target - self.force, self.step_n);
        self.force = if limited { self.force + step } else { target };
        (self.force, limited)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_device::{DeviceCaps, Workspace};
    use palpate_protocol::Span;
    use proptest::prelude::*;

    use super::{Slew, StiffnessCap, clamp_force};

    fn caps(max_stiffness_n_per_m: f64) -> DeviceCaps {
        let half = Vector3::repeat(0.1);
        DeviceCaps {
            name: "test".to_owned(),
            dof_in: 3,
            dof_out: 3,
            workspace: Workspace {
                min: -half,
                max: half,
            },
            max_force_n: 10.0,
            continuous_force_n: 5.0,
            max_torque_nm: 0.0,
            max_stiffness_n_per_m,
            rate_hz: 1000.0,
        }
    }

    #[test]
    fn the_smaller_of_device_and_damping_caps_stiffness() {
        let ms = Span::from_millis(1);
        assert_eq!(StiffnessCap::new(&caps(3000.0), 0.5, ms).apply(1e5), 1000.0);
        assert_eq!(StiffnessCap::new(&caps(700.0), 0.5, ms).apply(1e5), 700.0);
        assert_eq!(StiffnessCap::new(&caps(700.0), 0.5, ms).apply(200.0), 200.0);
    }

    #[test]
    fn a_target_that_is_not_a_number_counts_as_no_force() {
        let mut slew = Slew::new(0.5);
        slew.towards(Vector3::x());
        for bad in [f64::NAN, f64::INFINITY] {
            slew.towards(Vector3::new(bad, 0.0, 0.0));
        }
        assert_eq!(slew.force(), Vector3::zeros());
    }

    proptest! {
        #[test]
        fn a_clamp_never_turns_and_never_lengthens(x in -50.0f64..50.0, y in -50.0f64..50.0) {
            let f = Vector3::new(x, y, 1.0);
            let (c, limited) = clamp_force(f, 8.0);
            prop_assert!(c.norm() <= 8.0 + 1e-12 && c.norm() <= f.norm() + 1e-12);
            prop_assert!(c.cross(&f).norm() < 1e-9);
            prop_assert_eq!(limited, f.norm() > 8.0);
        }

        #[test]
        fn no_step_is_longer_than_the_limit_and_a_constant_target_is_reached(
            targets in proptest::collection::vec((-30.0f64..30.0, -30.0f64..30.0), 1..40)
        ) {
            let mut slew = Slew::new(0.6);
            for (x, y) in targets {
                let before = slew.force();
                let (after, _) = slew.towards(Vector3::new(x, y, 0.0));
                prop_assert!((after - before).norm() <= 0.6 + 1e-12);
            }
            for _ in 0..200 {
                slew.towards(Vector3::zeros());
            }
            prop_assert_eq!(slew.force(), Vector3::zeros());
        }
    }
}
