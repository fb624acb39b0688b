//! The energy that crosses the handle, observed and not yet acted upon.
//!
//! ```text
//! E_k = E_(k−1) − F_(k−1) · (x_k − x_(k−1))
//! ```
//!
//! F is held from tick to tick, so the sum is exact for what the device renders. Positive: the
//! hand has put energy in. A passive environment never lets it fall below zero (Hannaford and Ryu
//! 2002); how far it does is a measure of how active the loop is.

use nalgebra::Vector3;

/// Sums the energy the hand puts in.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EnergyObserver {
    energy_j: f64,
    min_j: f64,
    last: Option<(Vector3<f64>, Vector3<f64>)>,
}

impl EnergyObserver {
    /// The tool is at `x` (m) and will be pushed by `force` (N) until the next call.
    pub fn observe(&mut self, x: Vector3<f64>, force: Vector3<f64>) {
        if let Some((x_before, f_before)) = self.last {
            self.energy_j -= f_before.dot(&(x - x_before));
            self.min_j = self.min_j.min(self.energy_j);
        }
        self.last = Some((x, force));
    }

    /// What pushes the tool until the next call is `force` (N), and not what was said.
    pub fn correct(&mut self, force: Vector3<f64>) {
        if let Some((_, last)) = &mut self.last {
            *last = force;
        }
    }

    /// The path is broken (a bad sample); the sum goes on from the next call.
    pub fn interrupt(&mut self) {
        self.last = None;
    }

    /// Energy put in so far, J.
    pub fn energy_j(&self) -> f64 {
        self.energy_j
    }

    /// The smallest it has been, J.
    pub fn min_j(&self) -> f64 {
        self.min_j
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::EnergyObserver;

    #[test]
    fn a_held_spring_gives_back_more_than_it_was_given() {
        // K = 1000 N/m pressed 10 mm and released in steps of 1 mm: K/2 * steps * step².
        let mut e = EnergyObserver::default();
        for x in (0_i32..=10).chain((0..10).rev()) {
            let x = Vector3::new(f64::from(x) * 1e-3, 0.0, 0.0);
            e.observe(x, x * -1000.0);
        }
        assert!((e.energy_j() + 0.5 * 1000.0 * 20.0 * 1e-6).abs() < 1e-12);
        assert!(e.min_j() <= e.energy_j());
    }
}
