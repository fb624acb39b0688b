//! A random hand: slow motion of a given rms speed plus physiological tremor, from a seed.
//!
//! On every axis the slow part is a sum of sines between 0.2 and 1.6 Hz (the band of deliberate motion;
//! tracking ends at 2 Hz). Amplitudes fall as 1/f, so that every octave has an equal share of the speed. The
//! tremor is a sum of sines between 8 and 12 Hz. Sums of sines have exact derivatives, and every seed reaches
//! the requested rms up to rounding.
//!
//! The three components of the rotation vector are such sums too, with an angular speed and a tremor in
//! radians. The rotation stays below 0.5 rad, where the rate of the vector is the angular speed within a few
//! per cent.

use std::f64::consts::TAU;

use nalgebra::{UnitQuaternion, Vector3};
use palpate_protocol::Pose;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::Hand;

/// Band of deliberate motion, Hz.
const SLOW_HZ: (f64, f64) = (0.2, 1.6);

/// Band of physiological tremor, Hz.
const TREMOR_HZ: (f64, f64) = (8.0, 12.0);
const SLOW: usize = 6;

/// Sines of the tremor per axis: enough for a varying amplitude.
const TREMOR: usize = 3;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandParameters {
    /// Rms speed of the slow part, m/s.
    pub speed_rms_m_s: f64,
    /// Amplitude of the tremor on each axis, m: √2 times its rms, as for one sine.
    pub tremor_m: f64,
    /// Rms rate of the slow rotation vector, rad/s.
    pub turn_rms_rad_s: f64,
    /// Amplitude of the tremor about each axis, rad, as in [`tremor_m`](Self::tremor_m).
    pub tremor_rad: f64,
}

impl Default for HandParameters {
    /// The hand that reproduces table 7.1: 87 mm/s and 0.1 mm. Its rotation is that about a wrist 0.1 m away
    /// (reconstructed; the source has no rotations): 0.87 rad/s and 1 mrad.
    fn default() -> Self {
        Self {
            speed_rms_m_s: 0.087,
            tremor_m: 1e-4,
            turn_rms_rad_s: 0.87,
            tremor_rad: 1e-3,
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Sine {
    /// Metres along an axis, radians about one.
    amplitude: f64,
    omega: f64,
    phase: f64,
}

/// A random hand; its motion is endless.
#[derive(Debug, Clone)]
pub struct Random {
    along: [Vec<Sine>; 3],
    about: [Vec<Sine>; 3],
}

impl Random {
    pub fn new(parameters: HandParameters, seed: u64) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        // Positions first, so that they do not depend on the rotation.
        let along = sines(&mut rng, parameters.speed_rms_m_s, parameters.tremor_m);
        let about = sines(&mut rng, parameters.turn_rms_rad_s, parameters.tremor_rad);
        Self { along, about }
    }
}

/// Slow part and tremor on three axes: rms rate of all three together, and amplitude on each.
fn sines(rng: &mut Pcg64, rate_rms: f64, tremor: f64) -> [Vec<Sine>; 3] {
    std::array::from_fn(|_| {
        let mut sines = Vec::with_capacity(SLOW + TREMOR);
        // A sine of amplitude A has the mean square speed (Aω)²/2; with A ~ 1/ω all have an equal share.
        let speed = rate_rms * (2.0 / (3.0 * SLOW as f64)).sqrt();
        for k in 0..SLOW {
            let omega = TAU * strewn(rng, SLOW_HZ, k, SLOW);
            sines.push(Sine {
                amplitude: speed / omega,
                omega,
                phase: rng.random_range(0.0..TAU),
            });
        }
        let tremor = tremor / (TREMOR as f64).sqrt();
        for k in 0..TREMOR {
            sines.push(Sine {
                amplitude: tremor,
                omega: TAU * strewn(rng, TREMOR_HZ, k, TREMOR),
                phase: rng.random_range(0.0..TAU),
            });
        }
        sines
    })
}

/// A frequency in part `k` of `n` equal logarithmic parts of a band, so that every seed fills the band.
fn strewn(rng: &mut Pcg64, (low, high): (f64, f64), k: usize, n: usize) -> f64 {
    let share = (k as f64 + rng.random_range(0.0..1.0)) / n as f64;
    low * (high / low).powf(share)
}

impl Hand for Random {
    fn at(&self, t_s: f64) -> Pose {
        let sum = |sines: &Vec<Sine>| -> f64 {
            (sines.iter())
                .map(|s| s.amplitude * (s.omega * t_s + s.phase).sin())
                .sum()
        };
        let turn = Vector3::from_fn(|axis, _| sum(&self.about[axis]));
        let q = UnitQuaternion::from_scaled_axis(turn);
        Pose {
            position_m: std::array::from_fn(|axis| sum(&self.along[axis])),
            orientation: [q.i, q.j, q.k, q.w],
        }
    }

    fn length_s(&self) -> f64 {
        f64::INFINITY
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rms over 1000 s, with a step that shares no period with the band.
    fn rms(of: impl Fn(f64) -> f64) -> f64 {
        let n = 100_000;
        let sum: f64 = (0..n).map(|i| of(f64::from(i) * 0.010_07).powi(2)).sum();
        (sum / f64::from(n)).sqrt()
    }

    fn speed(hand: &Random, t_s: f64) -> f64 {
        let (a, b) = (hand.at(t_s).position_m, hand.at(t_s + 1e-5).position_m);
        (0..3)
            .map(|i| ((b[i] - a[i]) / 1e-5).powi(2))
            .sum::<f64>()
            .sqrt()
    }

    #[test]
    fn speed_and_tremor_match_the_parameters() {
        for seed in 0..4 {
            let calm = HandParameters {
                tremor_m: 0.0,
                ..HandParameters::default()
            };
            let slow = rms(|t| speed(&Random::new(calm, seed), t));
            assert!((slow / 0.087 - 1.0).abs() < 0.02, "{slow} m/s");
            let still = HandParameters {
                speed_rms_m_s: 0.0,
                tremor_m: 2e-4,
                ..HandParameters::default()
            };
            let hand = Random::new(still, seed);
            for axis in 0..3 {
                let amplitude = rms(|t| hand.at(t).position_m[axis]) * 2f64.sqrt();
                assert!((amplitude / 2e-4 - 1.0).abs() < 0.02, "{amplitude} m");
            }
        }
    }

    #[test]
    fn angular_speed_matches_the_parameters() {
        let turned = |hand: &Random, t_s: f64| {
            let q = |t_s: f64| {
                let [i, j, k, w] = hand.at(t_s).orientation;
                UnitQuaternion::new_normalize(nalgebra::Quaternion::new(w, i, j, k))
            };
            q(t_s).angle_to(&q(t_s + 1e-4)) / 1e-4
        };
        for seed in 0..4 {
            let calm = HandParameters {
                tremor_rad: 0.0,
                ..HandParameters::default()
            };
            let rate = rms(|t| turned(&Random::new(calm, seed), t));
            assert!((rate / 0.87 - 1.0).abs() < 0.05, "{rate} rad/s");
        }
    }

    #[test]
    fn equal_seeds_give_equal_hands() {
        let at = |seed| Random::new(HandParameters::default(), seed).at(1.234);
        assert_eq!(at(3), at(3));
        assert_ne!(at(3), at(4));
    }
}
