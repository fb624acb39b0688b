//! Random numbers per packet.
//!
//! Every purpose has an independent stream for every packet, derived from the packet number. A draw for one
//! purpose does not affect the others: more loss leaves the delays unchanged.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::link::Jitter;
use super::path::Direction;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    Loss = 1,
    State = 2,
    Delay = 3,
    Duplicate = 4,
    CopyDelay = 5,
    Corrupt = 6,
    CopyCorrupt = 7,
}

/// Bit mixing (the finaliser of splitmix64).
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Random numbers of one direction of one flow.
#[derive(Debug, Clone, Copy)]
pub(super) struct Draw {
    key: u64,
}

impl Draw {
    pub(super) fn new(seed: u64, flow: u64, direction: Direction) -> Self {
        let way = match direction {
            Direction::Up => 0x55,
            Direction::Down => 0xaa,
        };
        Self {
            key: mix(seed ^ mix(flow ^ mix(way << 8))),
        }
    }

    /// A number of both directions of a flow.
    pub(super) fn phase(seed: u64, flow: u64) -> u64 {
        mix(seed ^ mix(flow ^ mix(0x99 << 8)))
    }

    /// The stream of the `n`-th packet for a purpose.
    pub(super) fn stream(self, n: u64, purpose: Purpose) -> Pcg64 {
        let key = mix(self.key ^ mix(purpose as u64));
        Pcg64::seed_from_u64(mix(key ^ n.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    pub(super) fn share(self, n: u64, purpose: Purpose) -> f64 {
        self.stream(n, purpose).random()
    }
}

impl Jitter {
    pub(super) fn draw_ms(&self, rng: &mut Pcg64) -> f64 {
        match *self {
            Self::None => 0.0,
            Self::Uniform { reach_ms } => reach_ms * (2.0 * rng.random::<f64>() - 1.0),
            Self::Normal { deviation_ms } => deviation_ms * standard_normal(rng),
            Self::Gamma {
                mean_ms,
                deviation_ms,
            } => {
                let shape = (mean_ms / deviation_ms).powi(2);
                mean_ms / shape * standard_gamma(shape, rng)
            }
            Self::Pareto { scale_ms, exponent } => {
                let more = 1.0 - rng.random::<f64>();
                scale_ms * (more.powf(-1.0 / exponent) - 1.0)
            }
        }
    }
}

/// Box-Muller transform.
pub(crate) fn standard_normal(rng: &mut Pcg64) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Gamma distribution with scale 1 by rejection (Marsaglia and Tsang 2000, "A simple method for generating
/// gamma variables"). A shape below 1 is drawn with shape + 1 and multiplied by a power of a uniform number.
fn standard_gamma(shape: f64, rng: &mut Pcg64) -> f64 {
    if shape < 1.0 {
        let u: f64 = 1.0 - rng.random::<f64>();
        return standard_gamma(shape + 1.0, rng) * u.powf(1.0 / shape);
    }
    let d = shape - 1.0 / 3.0;
    let c = 1.0 / (9.0 * d).sqrt();
    loop {
        let x = standard_normal(rng);
        let v = (1.0 + c * x).powi(3);
        let u: f64 = 1.0 - rng.random::<f64>();
        // The acceptance probability is at least 0.95 for any shape, so the loop ends.
        if v > 0.0 && u.ln() < 0.5 * x * x + d - d * v + d * v.ln() {
            return d * v;
        }
    }
}
