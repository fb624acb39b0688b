//! A sensor that records a hand at its own rate and with noise.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use palpate_device::Buttons;
use palpate_device::backend::replay::{Moment, Motion};
use rand::SeedableRng;
use rand_pcg::Pcg64;

use super::Hand;
use crate::network::standard_normal;

/// Distance of the markers of a tool, which turns noise of positions into noise of rotations, m.
const LEVER_M: f64 = 0.1;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    pub rate_hz: f64,
    /// Standard deviation of white noise on each axis, m.
    pub noise_m: f64,
}

impl Sensor {
    /// Records the first `seconds` of a hand.
    pub fn record(&self, hand: &dyn Hand, seconds: f64, seed: u64) -> Result<Motion, String> {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut noise = || Vector3::from_fn(|_, _| self.noise_m * standard_normal(&mut rng));
        let moment = |k: u32| {
            let t_s = f64::from(k) / self.rate_hz;
            let truth = hand.at(t_s);
            let [i, j, l, w] = truth.orientation;
            let turned = UnitQuaternion::new_normalize(Quaternion::new(w, i, j, l));
            Moment {
                t_s,
                pose: palpate_device::Pose {
                    position: Vector3::from(truth.position_m) + noise(),
                    orientation: UnitQuaternion::from_scaled_axis(noise() / LEVER_M) * turned,
                },
                buttons: Buttons::NONE,
            }
        };
        let last = (seconds * self.rate_hz).floor() as u32;
        Motion::new((0..=last).map(moment).collect()).map_err(|e| e.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hand::{HandParameters, Random};

    #[test]
    fn recording_has_the_rate_and_the_noise_of_the_sensor() {
        let hand = Random::new(HandParameters::default(), 3);
        let sensor = Sensor {
            rate_hz: 100.0,
            noise_m: 3e-4,
        };
        let motion = sensor.record(&hand, 60.0, 3).unwrap();
        assert!((Hand::rate_hz(&motion).unwrap() - 100.0).abs() < 1e-6);
        let square = |m: &Moment| {
            let truth = Vector3::from(hand.at(m.t_s).position_m);
            (m.pose.position - truth).norm_squared() / 3.0
        };
        let moments = motion.moments();
        let variance = moments.iter().map(square).sum::<f64>() / moments.len() as f64;
        assert!((variance.sqrt() / 3e-4 - 1.0).abs() < 0.05, "{variance}");
    }
}
