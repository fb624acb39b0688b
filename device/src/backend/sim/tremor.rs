//! Physiological tremor: a few sines between 8 and 12 Hz along each axis, from a seed.

use std::f64::consts::TAU;

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::script::Hand;

/// The band of physiological tremor, Hz.
const BAND_HZ: (f64, f64) = (8.0, 12.0);

/// Sines per axis: enough that the sum waxes and wanes as a hand's does.
const SINES: usize = 3;

#[derive(Debug, Clone, Copy, Default)]
struct Sine {
    amplitude_m: f64,
    omega: f64,
    phase: f64,
}

#[derive(Debug)]
pub(in crate::backend) struct Tremor {
    axes: [[Sine; SINES]; 3],
    is_still: bool,
}

impl Tremor {
    /// The tremor of `hand`. The spring between script and hand weakens or amplifies it; each
    /// sine is given the amplitude that makes the free hand shake by `hand.tremor_m` rms.
    pub(in crate::backend) fn new(hand: &Hand) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(hand.seed);
        let amplitude_of_hand = hand.tremor_m * (2.0 / SINES as f64).sqrt();
        let mut axes = [[Sine::default(); SINES]; 3];
        for sine in axes.iter_mut().flatten() {
            let omega = TAU * rng.random_range(BAND_HZ.0..BAND_HZ.1);
            let amplitude_m = amplitude_of_hand / gain(hand, omega);
            *sine = Sine {
                amplitude_m,
                omega,
                phase: rng.random_range(0.0..TAU),
            };
        }
        Self {
            axes,
            is_still: hand.tremor_m == 0.0,
        }
    }

    /// Displacement (m) and velocity (m/s) of the script's end of the spring at `t_s`.
    pub(in crate::backend) fn at(&self, t_s: f64) -> (Vector3<f64>, Vector3<f64>) {
        let (mut x, mut v) = (Vector3::zeros(), Vector3::zeros());
        if self.is_still {
            return (x, v);
        }
        for (axis, sines) in self.axes.iter().enumerate() {
            for s in sines {
                let (sin, cos) = (s.omega * t_s + s.phase).sin_cos();
                x[axis] += s.amplitude_m * sin;
                v[axis] += s.amplitude_m * s.omega * cos;
            }
        }
        (x, v)
    }
}

/// |H(iω)| of the hand on its spring, H = (k + iωc) / (k − mω² + iωc).
fn gain(hand: &Hand, omega: f64) -> f64 {
    let damping = hand.damping_ns_per_m * omega;
    let inertia = hand.stiffness_n_per_m - hand.mass_kg * omega * omega;
    hand.stiffness_n_per_m.hypot(damping) / inertia.hypot(damping).max(1e-9)
}
