//! A hand that moves at random, the same for the same seed.

use rand::RngExt;
use rand_pcg::Pcg64;

/// How fast the hand is, root mean square, m/s: the motion of the stand-in for table 7.1.
pub const SPEED_RMS_M_S: f64 = 0.087;

/// Amplitude of the tremor, metres.
const TREMOR_M: f64 = 0.1e-3;

/// Sines per axis of what the hand means to do, 0.2 to 3 Hz.
const SINES: usize = 8;

/// Sines per axis of the tremor, 8 to 12 Hz (physiological).
const TREMOR_SINES: usize = 3;

#[derive(Debug, Clone, Copy)]
struct Sine {
    amplitude_m: f64,
    omega: f64,
    phase: f64,
}

/// Band-limited motion with tremor: sums of sines, so that it is known at every moment.
#[derive(Debug, Clone)]
pub struct Hand {
    axes: [Vec<Sine>; 3],
}

impl Hand {
    /// A hand of its own.
    pub fn new(rng: &mut Pcg64) -> Self {
        let mut sine = |from_hz: f64, until_hz: f64| Sine {
            amplitude_m: 0.0,
            omega: std::f64::consts::TAU * rng.random_range(from_hz..until_hz),
            phase: rng.random_range(0.0..std::f64::consts::TAU),
        };
        let axes = std::array::from_fn(|_| {
            let mut sines = Vec::with_capacity(SINES + TREMOR_SINES);
            for _ in 0..SINES {
                let s = sine(0.2, 3.0);
                // Every sine has the same share of the speed: slow ones reach farther.
                let speed = SPEED_RMS_M_S * (2.0 / (3.0 * SINES as f64)).sqrt();
                sines.push(Sine {
                    amplitude_m: speed / s.omega,
                    ..s
                });
            }
            for _ in 0..TREMOR_SINES {
                sines.push(Sine {
                    amplitude_m: TREMOR_M / (3.0 * TREMOR_SINES as f64).sqrt(),
                    ..sine(8.0, 12.0)
                });
            }
            sines
        });
        Self { axes }
    }

    /// Where the hand is at a moment, seconds to metres.
    pub fn at(&self, t_s: f64) -> [f64; 3] {
        std::array::from_fn(|axis| {
            let sines = self.axes[axis].iter();
            sines
                .map(|s| s.amplitude_m * (s.omega * t_s + s.phase).sin())
                .sum()
        })
    }
}
