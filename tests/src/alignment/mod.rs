//! Disagreement of two sites that align a shared part, in virtual time.
//!
//! Each site moves its own tool. Samples travel to the server in packets of four and on to the other site.
//! Both sites show both tools at s = t - D through the protocol's timelines. Clock, estimator, group,
//! schedule and timeline are the product's; network and hands are simulated. One minute takes a fraction of
//! a second and a seed reproduces it.
//!
//! The disagreement is the distance between the positions that the two sites show for one tool at one true
//! time (Lin 2007, figs 7.26 to 7.28).

mod controller;
mod motion;
mod predictor;
mod site;
pub mod two_sites;

use std::sync::Arc;

use palpate_protocol::compensation::CAP_DEFAULT;
use palpate_protocol::operation::{CompensationMode, CompensationSettings};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use serde::Serialize;

use crate::hand::Hand;
use crate::network::Profile;
pub use controller::Baseline;
use motion::hands;
use two_sites::{Moment, TwoSites};

/// Warm-up that is not measured, microseconds: clocks and delays settle.
pub const WARM_UP_US: i64 = 10_000_000;
pub const COUNTED_US: i64 = 60_000_000;

/// The longest measurement over a recorded network, microseconds: 15 minutes have 900,000 moments.
const COUNTED_MAX_US: i64 = 900_000_000;

/// Maximum 95th percentile of a safe disagreement, millimetres.
pub const SAFE_MM: f64 = 0.1;

/// Maximum shown step that is safe, millimetres.
pub const STEP_SAFE_MM: f64 = 1.0;
const FIXED_MAX_MS: u32 = 1000;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    None,
    Fixed(u32),
    Adaptive,
    /// An adaptive delay by a controller from the literature.
    Baseline(Baseline),
    /// The server's prediction instead of a delay: the alternative reading of the source.
    Predicted,
}

impl Mode {
    fn settings(self) -> CompensationSettings {
        let (mode, initial_delay_us) = match self {
            Self::None | Self::Predicted => (CompensationMode::None, 0),
            Self::Fixed(ms) => (CompensationMode::Fixed, ms * 1000),
            Self::Adaptive | Self::Baseline(_) => {
                let cap_us = u32::try_from(CAP_DEFAULT.as_micros()).unwrap_or(u32::MAX);
                (CompensationMode::Adaptive { cap_us }, 60_000)
            }
        };
        CompensationSettings {
            mode,
            initial_delay_us,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Disagreement {
    pub rms: f64,
    pub p95: f64,
    pub max: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Compensation {
    pub mean: f64,
    pub p95: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Figures {
    pub disagreement_mm: Disagreement,
    pub compensation_ms: Compensation,
    /// Number of changes of the disagreement by more than 1 mm in one millisecond.
    pub corrections_over_1mm: u64,
    /// Milliseconds in which a shown tool had no current samples.
    pub stale_ticks: u64,
}

impl Figures {
    pub fn is_safe(&self) -> bool {
        self.disagreement_mm.p95 <= SAFE_MM && self.corrections_over_1mm == 0
    }

    pub fn of(moments: &[Moment]) -> Self {
        let mut distances = Vec::with_capacity(2 * moments.len());
        let (mut over, mut stale) = (0, 0);
        let mut last: Option<[[f64; 3]; 2]> = None;
        for m in moments {
            let apart = [m.first, m.second].map(|[own, other]| sub(other, own));
            if let Some(last) = last {
                over += (0..2)
                    .filter(|&k| norm_mm(sub(apart[k], last[k])) > STEP_SAFE_MM)
                    .count() as u64;
            }
            distances.extend(apart.map(norm_mm));
            last = Some(apart);
            stale += u64::from(m.stale);
        }
        let mut delays: Vec<f64> = moments.iter().map(|m| m.delay_ms).collect();
        let n = distances.len().max(1) as f64;
        let rms = (distances.iter().map(|d| d * d).sum::<f64>() / n).sqrt();
        let mean = delays.iter().sum::<f64>() / delays.len().max(1) as f64;
        Self {
            disagreement_mm: Disagreement {
                rms,
                max: distances.iter().copied().fold(0.0, f64::max),
                p95: percentile(&mut distances, 0.95),
            },
            compensation_ms: Compensation {
                mean,
                p95: percentile(&mut delays, 0.95),
            },
            corrections_over_1mm: over,
            stale_ticks: stale,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrivals {
    /// Samples that arrived at the other site, each counted once.
    pub arrived: u64,
    /// Samples that both hands produce in a session, 1000 per second and hand.
    pub of: u64,
}

impl Arrivals {
    /// Minimum share of delivered samples, 0 to 1. The worst named network delivers more than half; at 1 %
    /// most of the shown motion would be at rest.
    const SHARE_MIN: f64 = 0.01;

    pub fn are_enough(self) -> bool {
        self.arrived as f64 >= Self::SHARE_MIN * self.of as f64
    }
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

fn norm_mm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt() * 1e3
}

fn percentile(values: &mut [f64], p: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let index = ((values.len() - 1) as f64 * p).round() as usize;
    *values.select_nth_unstable_by(index, f64::total_cmp).1
}

/// An alignment whose sites both reach the server over the same kind of network.
#[derive(Clone)]
pub struct Alignment {
    pub profile: Profile,
    pub seed: u64,
    /// Recorded motion for both hands with different offsets; `None` selects random motions.
    pub motion: Option<Arc<dyn Hand>>,
}

impl Alignment {
    /// Length of the measurement, microseconds: all of a recorded network, so that seeds differ by its beginning only.
    pub fn counted_us(&self) -> i64 {
        let trace_us = self.profile.trace_period_us();
        let trace_us = trace_us.map_or(0, |us| i64::try_from(us).unwrap_or(i64::MAX));
        trace_us.clamp(COUNTED_US, COUNTED_MAX_US)
    }

    pub fn moments(&self, mode: Mode) -> Vec<Moment> {
        let counted_us = self.counted_us();
        let mut moments = Vec::with_capacity((counted_us / 1000) as usize);
        self.simulation(mode)
            .run(WARM_UP_US, WARM_UP_US + counted_us, &mut |m| {
                moments.push(m);
            });
        moments
    }

    pub fn simulation(&self, mode: Mode) -> TwoSites {
        // Two generators separate the seed of the network from those of hands and clocks.
        let mut rng = Pcg64::seed_from_u64(self.seed ^ 0x70_61_74_68);
        let network_seed = Pcg64::seed_from_u64(rng.random()).random();
        let network = (&self.profile, network_seed);
        let hands = hands(self.motion.as_ref(), self.seed);
        let baseline = match mode {
            Mode::Baseline(baseline) => Some(baseline),
            _ => None,
        };
        let simulation = TwoSites::new(&mode.settings(), baseline, network, hands, self.seed);
        match mode {
            Mode::Predicted => simulation.predicted(),
            _ => simulation,
        }
    }

    /// Number of samples delivered to the other site. Counting stops after the first second with enough
    /// samples.
    pub fn arrivals(&self) -> Arrivals {
        let lasts_us = WARM_UP_US + self.counted_us();
        let of = 2 * (lasts_us / 1000) as u64;
        let mut simulation = self.simulation(Mode::None);
        let mut arrivals = Arrivals { arrived: 0, of };
        for second in 1..=lasts_us / 1_000_000 {
            simulation.run(i64::MAX, second * 1_000_000, &mut |_| {});
            arrivals.arrived = simulation.arrived();
            if arrivals.are_enough() {
                break;
            }
        }
        arrivals
    }

    pub fn figures(&self, mode: Mode) -> Figures {
        Figures::of(&self.moments(mode))
    }

    /// Smallest safe fixed delay in whole milliseconds, if any; `told` receives each tried delay.
    pub fn smallest_safe_fixed_ms(&self, told: &mut dyn FnMut(u32)) -> Option<u32> {
        let mut safe = |ms| {
            told(ms);
            self.figures(Mode::Fixed(ms)).is_safe()
        };
        let (mut low, mut high) = (0, 64);
        while !safe(high) {
            if high == FIXED_MAX_MS {
                return None;
            }
            low = high + 1;
            high = (2 * high).min(FIXED_MAX_MS);
        }
        while low < high {
            let middle = low.midpoint(high);
            if safe(middle) {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        Some(high)
    }
}

#[cfg(test)]
mod tests;
