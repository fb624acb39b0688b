//! A hand that wanders: slow motion of a given rms speed, with physiological tremor on top, from a seed.
//!
//! Along every axis the slow part is a sum of sines with frequencies spread over 0.2 to 1.6 Hz (the band of deliberate
//! motion; tracking ends at 2 Hz) whose amplitudes fall as 1/f, so that every octave has its share of the speed; the
//! tremor is a sum of sines between 8 and 12 Hz. Sums of sines are known with all their derivatives at every moment,
//! and reach what was asked for to the rounding, not only in the mean of many seeds.
//!
//! It turns in the same way: the three parts of its rotation vector are such sums, of an angular speed and a tremor in
//! radians. The turn stays below half a radian, where the vector's rate is the angular speed within some per cent.

use std::f64::consts::TAU;

use nalgebra::{UnitQuaternion, Vector3};
use palpate_protocol::Pose;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::Hand;

/// The band of deliberate motion, Hz.
const SLOW_HZ: (f64, f64) = (0.2, 1.6);

/// The band of physiological tremor, Hz.
const TREMOR_HZ: (f64, f64) = (8.0, 12.0);

/// Sines of the slow part along each axis.
const SLOW: usize = 6;

/// Sines of the tremor along each axis: enough that it waxes and wanes.
const TREMOR: usize = 3;

/// What a hand is like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Temper {
    /// Root mean square of the speed of the slow part, m/s.
    pub speed_rms_m_s: f64,
    /// Amplitude of the tremor along each axis, m: √2 times its rms, as of one sine.
    pub tremor_m: f64,
    /// Root mean square of the rate of the rotation vector's slow part, rad/s.
    pub turn_rms_rad_s: f64,
    /// Amplitude of the tremor about each axis, rad, as [`tremor_m`](Self::tremor_m).
    pub tremor_rad: f64,
}

impl Default for Temper {
    /// The hand of the stand-in for table 7.1: 87 mm/s and 0.1 mm. It turns as if that were the motion about a wrist
    /// 0.1 m away (reconstructed: nothing is known of turns there): 0.87 rad/s and 1 mrad.
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
    /// In m along an axis, in rad about one.
    amplitude: f64,
    omega: f64,
    phase: f64,
}

/// A wandering hand. It has no end.
#[derive(Debug, Clone)]
pub struct Random {
    along: [Vec<Sine>; 3],
    about: [Vec<Sine>; 3],
}

impl Random {
    /// The hand of that temper and seed.
    pub fn new(temper: Temper, seed: u64) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        // Places first, so that a seed's places are the same whether or not it turns.
        let along = sines(&mut rng, temper.speed_rms_m_s, temper.tremor_m);
        let about = sines(&mut rng, temper.turn_rms_rad_s, temper.tremor_rad);
        Self { along, about }
    }
}

/// Slow part and tremor along three axes: root mean square of the rate of all three together, and amplitude along each.
fn sines(rng: &mut Pcg64, rate_rms: f64, tremor: f64) -> [Vec<Sine>; 3] {
    std::array::from_fn(|_| {
        let mut sines = Vec::with_capacity(SLOW + TREMOR);
        // A sine of amplitude A has the mean square speed (Aω)²/2; with A ~ 1/ω all share alike.
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

/// A frequency in part `k` of `n` equal parts of the logarithm of a band: a band is filled whatever the seed.
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

    /// Root mean square over 1000 s, in steps that share no period with the band.
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
    fn speed_and_tremor_come_out_as_they_were_asked_for() {
        for seed in 0..4 {
            let calm = Temper {
                tremor_m: 0.0,
                ..Temper::default()
            };
            let slow = rms(|t| speed(&Random::new(calm, seed), t));
            assert!((slow / 0.087 - 1.0).abs() < 0.02, "{slow} m/s");
            let still = Temper {
                speed_rms_m_s: 0.0,
                tremor_m: 2e-4,
                ..Temper::default()
            };
            let hand = Random::new(still, seed);
            for axis in 0..3 {
                let amplitude = rms(|t| hand.at(t).position_m[axis]) * 2f64.sqrt();
                assert!((amplitude / 2e-4 - 1.0).abs() < 0.02, "{amplitude} m");
            }
        }
    }

    #[test]
    fn it_turns_as_fast_as_was_asked_for() {
        let turned = |hand: &Random, t_s: f64| {
            let q = |t_s: f64| {
                let [i, j, k, w] = hand.at(t_s).orientation;
                UnitQuaternion::new_normalize(nalgebra::Quaternion::new(w, i, j, k))
            };
            q(t_s).angle_to(&q(t_s + 1e-4)) / 1e-4
        };
        for seed in 0..4 {
            let calm = Temper {
                tremor_rad: 0.0,
                ..Temper::default()
            };
            let rate = rms(|t| turned(&Random::new(calm, seed), t));
            assert!((rate / 0.87 - 1.0).abs() < 0.05, "{rate} rad/s");
        }
    }

    #[test]
    fn a_seed_is_a_hand() {
        let at = |seed| Random::new(Temper::default(), seed).at(1.234);
        assert_eq!(at(3), at(3));
        assert_ne!(at(3), at(4));
    }
}
