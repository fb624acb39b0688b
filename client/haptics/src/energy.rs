//! Observes the energy that crosses the handle, without acting on it.
//!
//! ```text
//! E_k = E_(k−1) − F_(k−1) · (x_k − x_(k−1)) − T_(k−1) · θ_k
//! ```
//!
//! with θ the rotation vector from the last orientation to this one. F and T are held from tick to tick, so the sum
//! is exact for the rendered wrench (for the torque, if the turn of a tick is about one axis). Positive: the hand
//! has put energy in. A passive environment never lets it fall below zero (Hannaford and Ryu 2002); its minimum
//! measures the activity of the loop.

use nalgebra::Vector3;
use palpate_device::{Pose, Wrench};

/// The rotation vector from one orientation to the other, rad, along the scene's axes.
pub(crate) fn turned(from: &Pose, to: &Pose) -> Vector3<f64> {
    from.orientation.rotation_to(&to.orientation).scaled_axis()
}

/// Work of a held wrench from one pose to the other, J.
pub(crate) fn work(wrench: &Wrench, from: &Pose, to: &Pose) -> f64 {
    let moving = wrench.force.dot(&(to.position - from.position));
    if wrench.torque == Vector3::zeros() {
        moving
    } else {
        moving + wrench.torque.dot(&turned(from, to))
    }
}

/// Sums the energy that the hand puts in.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct EnergyObserver {
    energy_j: f64,
    min_j: f64,
    last: Option<(Pose, Wrench)>,
}

impl EnergyObserver {
    /// The tool is at `pose`, and `wrench` acts on it until the next call.
    pub(crate) fn observe(&mut self, pose: Pose, wrench: Wrench) {
        if let Some((before, held)) = &self.last {
            self.energy_j -= work(held, before, &pose);
            self.min_j = self.min_j.min(self.energy_j);
        }
        self.last = Some((pose, wrench));
    }

    /// Replaces the wrench of the last call by the rendered one.
    pub(crate) fn correct(&mut self, wrench: Wrench) {
        if let Some((_, last)) = &mut self.last {
            *last = wrench;
        }
    }

    /// The path is broken (a bad sample); the sum continues from the next call.
    pub(crate) fn interrupt(&mut self) {
        self.last = None;
    }

    /// The smallest it has been, J.
    pub(crate) fn min_j(&self) -> f64 {
        self.min_j
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use palpate_device::{Pose, Wrench};

    use super::EnergyObserver;

    #[test]
    fn a_sampled_spring_returns_more_energy_than_it_received() {
        // K = 1000 N/m pressed 10 mm and released in steps of 1 mm: K/2 * steps * step².
        let mut e = EnergyObserver::default();
        for x in (0_i32..=10).chain((0..10).rev()) {
            let x = Vector3::new(f64::from(x) * 1e-3, 0.0, 0.0);
            e.observe(Pose::at(x), Wrench::from_force(x * -1000.0));
        }
        assert!((e.energy_j + 0.5 * 1000.0 * 20.0 * 1e-6).abs() < 1e-12);
        assert!(e.min_j() <= e.energy_j);
    }

    #[test]
    fn work_of_a_held_torque_is_torque_times_angle() {
        let mut e = EnergyObserver::default();
        let axis = Vector3::new(1.0, 2.0, -1.0).normalize();
        let wrench = Wrench {
            force: Vector3::zeros(),
            torque: axis * 0.3,
        };
        // The hand turns against it, from an orientation unrelated to the axis.
        let start = UnitQuaternion::new(Vector3::new(0.4, 0.0, 1.1));
        for step in 0..=50 {
            let orientation = UnitQuaternion::new(axis * (-0.01 * f64::from(step))) * start;
            let pose = Pose {
                orientation,
                ..Pose::default()
            };
            e.observe(pose, wrench);
        }
        assert!((e.energy_j - 0.3 * 0.5).abs() < 1e-12, "{} J", e.energy_j);
    }
}
