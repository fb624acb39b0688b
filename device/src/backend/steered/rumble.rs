//! Rumble of a gamepad as a cue for a force that can not be rendered.

use crate::{DeviceTime, Wrench};

/// Minimum time between two changes, µs: 30 a second. Motors with an unbalanced mass need longer than that to
/// change their speed.
const CHANGE_EVERY_US: i64 = 33_333;

/// The law from force to strength:
///
/// ```text
/// s = 0                                   where |F| < onset
/// s = s0 + (1 - s0) min(1, |F| / full)    elsewhere
/// ```
///
/// with the largest |F| since the last change, so that a short touch is not missed. The law is our own. A motor
/// does not turn at all below some tenth of its voltage, hence s0. The cue has no direction and is not a force in
/// newtons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rumble {
    /// Below this the tool counts as free, N.
    pub onset_n: f64,
    /// The force of full strength, N.
    pub full_n: f64,
    /// The strength at the onset, 0 to 1.
    pub least: f64,
}

impl Default for Rumble {
    /// From 0.05 N to 5 N, which is a firm press into soft tissue.
    fn default() -> Self {
        Self {
            onset_n: 0.05,
            full_n: 5.0,
            least: 0.15,
        }
    }
}

impl Rumble {
    /// The strength for a force of `force_n`, 0 to 1; 0 for NaN.
    pub fn strength(&self, force_n: f64) -> f64 {
        if !(force_n >= self.onset_n && force_n.is_finite()) {
            return 0.0;
        }
        self.least + (1.0 - self.least) * (force_n / self.full_n).min(1.0)
    }
}

/// Limits the rate of changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shaker {
    law: Rumble,
    peak_n: f64,
    said_at: Option<DeviceTime>,
}

impl Shaker {
    pub(super) fn new(law: Rumble) -> Self {
        Self {
            law,
            peak_n: 0.0,
            said_at: None,
        }
    }

    /// Adds the force on the tool at `now`; returns the strength when a change is due.
    pub(super) fn feel(&mut self, now: DeviceTime, felt: &Wrench) -> Option<f64> {
        // The larger of the two, and never NaN.
        self.peak_n = self.peak_n.max(felt.force.norm());
        if self
            .said_at
            .is_some_and(|at| now.micros_since(at) < CHANGE_EVERY_US)
        {
            return None;
        }
        self.said_at = Some(now);
        let strength = self.law.strength(self.peak_n);
        self.peak_n = 0.0;
        Some(strength)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::{CHANGE_EVERY_US, Rumble, Shaker};
    use crate::{DeviceTime, Wrench};

    fn push(n: f64) -> Wrench {
        Wrench::from_force(Vector3::new(0.0, n, 0.0))
    }

    proptest! {
        #[test]
        fn strength_is_monotonic_and_at_most_one(a in -1.0..50.0f64, b in -1.0..50.0f64) {
            let law = Rumble::default();
            let (less, more) = (law.strength(a.min(b)), law.strength(a.max(b)));
            prop_assert!(less <= more && (0.0..=1.0).contains(&less) && (0.0..=1.0).contains(&more));
        }
    }

    #[test]
    fn a_free_tool_and_a_nan_force_do_not_rumble() {
        let law = Rumble::default();
        assert_eq!(law.strength(0.04), 0.0);
        assert!(law.strength(0.05) > 0.15);
        assert_eq!(law.strength(5.0), 1.0);
        assert_eq!(law.strength(f64::NAN), 0.0);
        assert_eq!(law.strength(f64::INFINITY), 0.0);
    }

    #[test]
    fn strength_changes_at_most_thirty_times_a_second_and_misses_no_touch() {
        let mut shaker = Shaker::new(Rumble::default());
        let mut said = Vec::new();
        for tick in 0..1000 {
            // One millisecond of contact, half a second in.
            let n = if tick == 500 { 5.0 } else { 0.0 };
            said.extend(shaker.feel(DeviceTime::from_micros(tick * 1000), &push(n)));
        }
        assert!(said.len() <= (1_000_000 / CHANGE_EVERY_US) as usize + 1);
        assert_eq!(said.iter().filter(|s| **s == 1.0).count(), 1);
        assert_eq!(said.last(), Some(&0.0));
    }

    #[test]
    fn a_nan_force_leaves_no_state() {
        let mut shaker = Shaker::new(Rumble::default());
        assert_eq!(shaker.feel(DeviceTime::ZERO, &push(f64::NAN)), Some(0.0));
        let later = DeviceTime::from_micros(CHANGE_EVERY_US);
        assert_eq!(shaker.feel(later, &push(5.0)), Some(1.0));
    }
}
