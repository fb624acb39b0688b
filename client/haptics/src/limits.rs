//! Limits of stiffness, force and slew rate.

use nalgebra::Vector3;
use palpate_device::{DeviceCaps, Wrench};
use palpate_protocol::Span;

/// The largest stiffness the loop renders, N/m.
///
/// A sampled spring K held for a period T behind a device of damping b is passive while K <= 2 b / T (Colgate and
/// Schenkel 1997). A stiffer contact keeps its solved force but follows the hand with this slope between two
/// solves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StiffnessCap(f64);

impl StiffnessCap {
    /// The smaller of the device's limit and 2 b / T, with `damping_ns_per_m` = b. A device without motors has no
    /// limit of its own, so only 2 b / T applies.
    pub(crate) fn new(caps: &DeviceCaps, damping_ns_per_m: f64, period: Span) -> Self {
        let stable = 2.0 * damping_ns_per_m / period.as_secs_f64();
        Self(if caps.dof_out == 0 {
            stable
        } else {
            caps.max_stiffness_n_per_m.min(stable)
        })
    }

    /// The cap, N/m.
    pub(crate) fn n_per_m(self) -> f64 {
        self.0
    }

    /// `stiffness` (N/m), capped.
    pub(crate) fn apply(self, stiffness: f64) -> f64 {
        stiffness.clamp(0.0, self.0)
    }
}

/// `force` (or a torque) shortened to `limit`, in the same unit, and whether it was longer. The direction is kept.
pub(crate) fn clamp_force(force: Vector3<f64>, limit: f64) -> (Vector3<f64>, bool) {
    let n = force.norm();
    if n > limit {
        (force * (limit / n), true)
    } else {
        (force, false)
    }
}

/// Changes a force, or a torque, by no more than a fixed step per tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Slew {
    step: f64,
    now: Vector3<f64>,
}

impl Slew {
    /// From zero, at most `step` newtons (newton metres for a torque) per tick.
    pub(crate) fn new(step: f64) -> Self {
        Self {
            step,
            now: Vector3::zeros(),
        }
    }

    /// The step, N or N·m per tick.
    pub(crate) fn step(&self) -> f64 {
        self.step
    }

    /// The output of the last tick, N or N·m.
    pub(crate) fn now(&self) -> Vector3<f64> {
        self.now
    }

    /// Replaces the state by the rendered value `now` (N or N·m); the next step starts there. A non-finite value
    /// counts as zero.
    pub(crate) fn begin_at(&mut self, now: Vector3<f64>) {
        let is_finite = now.iter().all(|c| c.is_finite());
        self.now = if is_finite { now } else { Vector3::zeros() };
    }

    /// The next output towards `target` without a state change, N or N·m.
    pub(crate) fn peek(&self, target: Vector3<f64>) -> Vector3<f64> {
        let mut ahead = *self;
        ahead.towards(target).0
    }

    /// Steps towards `target`; returns the output and whether the step was limited. A non-finite target counts as
    /// zero, because this is the last stage before the hand.
    pub(crate) fn towards(&mut self, target: Vector3<f64>) -> (Vector3<f64>, bool) {
        let is_finite = target.iter().all(|c| c.is_finite());
        let target = if is_finite { target } else { Vector3::zeros() };
        let (step, limited) = clamp_force(target - self.now, self.step);
        self.now = if limited { self.now + step } else { target };
        (self.now, limited)
    }
}

/// The last stage: limits the change of force and torque per tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct WrenchSlew {
    /// Of the force.
    pub force: Slew,
    /// Of the torque.
    pub torque: Slew,
}

impl WrenchSlew {
    /// The output of the last tick.
    pub(crate) fn now(&self) -> Wrench {
        Wrench {
            force: self.force.now(),
            torque: self.torque.now(),
        }
    }

    /// Replaces the state by the rendered `wrench`; the next steps start there. Non-finite parts count as zero.
    pub(crate) fn begin_at(&mut self, wrench: &Wrench) {
        self.force.begin_at(wrench.force);
        self.torque.begin_at(wrench.torque);
    }

    /// The next output towards `target` without a state change.
    pub(crate) fn peek(&self, target: &Wrench) -> Wrench {
        Wrench {
            force: self.force.peek(target.force),
            torque: self.torque.peek(target.torque),
        }
    }

    /// Steps towards `target`; returns the output, and whether the force and the torque were limited.
    pub(crate) fn towards(&mut self, target: &Wrench) -> (Wrench, [bool; 2]) {
        let (force, forced) = self.force.towards(target.force);
        let (torque, turned) = self.torque.towards(target.torque);
        (Wrench { force, torque }, [forced, turned])
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
    fn stiffness_is_capped_by_the_smaller_of_device_and_damping() {
        let ms = Span::from_millis(1);
        assert_eq!(StiffnessCap::new(&caps(3000.0), 0.5, ms).apply(1e5), 1000.0);
        assert_eq!(StiffnessCap::new(&caps(700.0), 0.5, ms).apply(1e5), 700.0);
        assert_eq!(StiffnessCap::new(&caps(700.0), 0.5, ms).apply(200.0), 200.0);
    }

    #[test]
    fn a_non_finite_target_counts_as_zero() {
        let mut slew = Slew::new(0.5);
        slew.towards(Vector3::x());
        for bad in [f64::NAN, f64::INFINITY] {
            slew.towards(Vector3::new(bad, 0.0, 0.0));
        }
        assert_eq!(slew.now(), Vector3::zeros());
    }

    proptest! {
        #[test]
        fn a_clamp_keeps_the_direction_and_never_lengthens(x in -50.0f64..50.0, y in -50.0f64..50.0) {
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
                let before = slew.now();
                let (after, _) = slew.towards(Vector3::new(x, y, 0.0));
                prop_assert!((after - before).norm() <= 0.6 + 1e-12);
            }
            for _ in 0..200 {
                slew.towards(Vector3::zeros());
            }
            prop_assert_eq!(slew.now(), Vector3::zeros());
        }
    }
}
