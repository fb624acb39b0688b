//! A Kalman filter of a tool's pose whose acceleration is a first-order Gauss-Markov process.
//!
//! The target model of Singer (1970; Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2): the
//! acceleration decays with the time constant τ and is driven by white noise of density q; a sample has
//! white noise of density r. Only q/r matters for the gains. The poles of the steady-state filter are
//! those of a third-order Butterworth low-pass (for τ = ∞) with the cut-off
//!
//! ```text
//! ω = (q / r)^(1/6)
//! ```
//!
//! In units of 1/ω all filters are equal (h = ω T between samples, q = 1, variance 1/h of a sample, and
//! τ = 6), so that ω is the only parameter, independent of the sample rate.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use crate::verlet::Vec3;

/// Components of a pose: position in metres, then a quaternion (x, y, z, w).
pub(super) type Components = SVector<f64, 7>;

/// Time constant τ of the acceleration in units of 1/ω. Of 3, 4.5, 6 and 8 the best, or within 1 % of
/// it, over hands, trackers and master devices.
const FADES: f64 = 6.0;

/// Variances of the first position, velocity and acceleration: those of the steady state are below 3.
const FIRST_VARIANCE: f64 = 30.0;

#[derive(Debug, Clone, Copy)]
pub(super) struct Kalman {
    /// ω, rad/s.
    cutoff: f64,
    covariance: Matrix3<f64>,
    /// Pose, velocity and acceleration (rows), in units of 1/ω.
    state: SMatrix<f64, 3, 7>,
}

/// Position, velocity and acceleration after `h`.
fn transition(h: f64) -> Matrix3<f64> {
    let left = (-h / FADES).exp();
    let (travel, gain) = (
        FADES * FADES * (left - 1.0 + h / FADES),
        FADES * (1.0 - left),
    );
    Matrix3::new(1.0, h, travel, 0.0, 1.0, gain, 0.0, 0.0, left)
}

impl Kalman {
    pub(super) fn new(cutoff: f64, first: &Components) -> Self {
        let mut state = SMatrix::<f64, 3, 7>::zeros();
        state.set_row(0, &first.transpose());
        Self {
            cutoff,
            covariance: Matrix3::from_diagonal_element(FIRST_VARIANCE),
            state,
        }
    }

    /// Takes the sample `elapsed_s` after the previous one.
    pub(super) fn update(&mut self, elapsed_s: f64, sample: &Components) {
        let h = self.cutoff * elapsed_s;
        let f = transition(h);
        // White noise of the acceleration's rate, integrated: the limit of Singer's matrix for h << τ.
        let q = |divisor: f64, power: i32| h.powi(power) / divisor;
        let noise = Matrix3::new(
            q(20.0, 5),
            q(8.0, 4),
            q(6.0, 3), //
            q(8.0, 4),
            q(3.0, 3),
            q(2.0, 2), //
            q(6.0, 3),
            q(2.0, 2),
            q(1.0, 1),
        );
        self.state = f * self.state;
        self.covariance = f * self.covariance * f.transpose() + noise;
        let row = self.covariance.row(0).into_owned();
        let gain: Vector3<f64> = row.transpose() / (row[0] + 1.0 / h);
        self.state += gain * (sample.transpose() - self.state.row(0));
        self.covariance -= gain * row;
    }

    /// The components, and the velocity of the position, `s` seconds after the newest sample.
    pub(super) fn on(&self, s: f64) -> (Components, Vec3) {
        let ahead = transition(self.cutoff * s) * self.state;
        let velocity = std::array::from_fn(|axis| self.cutoff * ahead[(1, axis)]);
        (ahead.row(0).transpose(), velocity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(x: f64) -> Components {
        Components::from_element(x)
    }

    #[test]
    fn line_is_extrapolated_exactly_once_the_filter_has_settled() {
        for (cutoff, period_s) in [(30.0, 1e-3), (30.0, 1e-2), (240.0, 1e-3), (240.0, 1e-2)] {
            let mut filter = Kalman::new(cutoff, &all(0.0));
            for k in 1..1000 {
                filter.update(period_s, &all(0.2 * f64::from(k) * period_s));
            }
            let (x, v) = filter.on(0.05);
            assert!((x[6] - 0.2 * (999.0 * period_s + 0.05)).abs() < 1e-6, "{x}");
            assert!((v[2] - 0.2).abs() < 1e-4);
        }
    }

    #[test]
    fn sines_below_the_cutoff_pass_and_those_above_are_damped() {
        let gain = |omega: f64| {
            let mut filter = Kalman::new(30.0, &all(0.0));
            let (mut power, n) = (0.0, 20_000);
            for k in 0..n {
                filter.update(1e-3, &all((omega * f64::from(k) * 1e-3).sin()));
                let settled = if k < n / 2 { 0.0 } else { 4.0 / f64::from(n) };
                power += settled * filter.on(0.0).0[0].powi(2);
            }
            power.sqrt()
        };
        assert!((gain(3.0) - 1.0).abs() < 0.05, "{}", gain(3.0));
        // The closed loop of three integrators, (2 s² + 2 s + 1) / (s³ + 2 s² + 2 s + 1) at s = 10 i.
        assert!((gain(300.0) - 0.2).abs() < 0.03, "{}", gain(300.0));
    }
}
