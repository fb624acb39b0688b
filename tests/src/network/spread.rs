//! Mean and deviation of the delay of a profile, computed from its distributions.

use super::{Jitter, Link, Profile};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    pub mean_ms: f64,
    /// Standard deviation, ms; infinite for distributions without one.
    pub deviation_ms: f64,
    /// Maximum increase of the mean by bursts, steps, queues and traces, ms; infinite with outages.
    pub at_worst_ms: f64,
}

impl Jitter {
    pub fn moments_ms(&self) -> (f64, f64) {
        match *self {
            Self::None => (0.0, 0.0),
            Self::Uniform { reach_ms } => (0.0, reach_ms / 3f64.sqrt()),
            Self::Normal { deviation_ms } => (0.0, deviation_ms),
            Self::Gamma {
                mean_ms,
                deviation_ms,
            } => (mean_ms, deviation_ms),
            Self::Pareto { scale_ms, exponent } => {
                let a = exponent;
                let mean = if a > 1.0 {
                    scale_ms / (a - 1.0)
                } else {
                    f64::INFINITY
                };
                let deviation = if a > 2.0 {
                    mean * (a / (a - 2.0)).sqrt()
                } else {
                    f64::INFINITY
                };
                (mean, deviation)
            }
        }
    }
}

impl Link {
    /// Whether the delay is a constant plus jitter, so that mean and standard deviation describe it.
    pub fn is_steady(&self) -> bool {
        self.steps.is_none()
            && self.bursts.is_none()
            && self.rate.is_none()
            && self.outages.is_none()
            && self.trace.is_none()
    }

    /// Its delay, without the additional delay of keeping the order.
    pub fn spread(&self) -> Spread {
        let (mean_ms, deviation_ms) = self.jitter.moments_ms();
        let steps = self.steps.iter().flat_map(|s| &s.delays);
        let highest = steps.map(|s| s.delay_ms).fold(self.delay_ms, f64::max);
        let recorded = self.trace.iter().flat_map(super::trace::Trace::rows);
        let mut at_worst_ms = highest - self.delay_ms;
        at_worst_ms += self.bursts.map_or(0.0, |b| b.delay_ms);
        at_worst_ms += self
            .rate
            .map_or(0.0, |r| 8e3 * r.queue_bytes as f64 / r.bits_per_s);
        at_worst_ms += recorded.map(|r| r.delay_ms).fold(0.0, f64::max);
        let is_cut_off =
            self.outages.is_some() || self.trace.iter().any(|t| t.rows().iter().any(|r| r.lost));
        if is_cut_off {
            at_worst_ms = f64::INFINITY;
        }
        Spread {
            mean_ms: self.delay_ms + mean_ms,
            deviation_ms,
            at_worst_ms,
        }
    }
}

impl Profile {
    pub fn is_steady(&self) -> bool {
        self.up.is_steady() && self.down.is_steady()
    }

    /// Uplink plus downlink.
    pub fn round_trip(&self) -> Spread {
        let [up, down] = [self.up.spread(), self.down.spread()];
        Spread {
            mean_ms: up.mean_ms + down.mean_ms,
            deviation_ms: up.deviation_ms.hypot(down.deviation_ms),
            at_worst_ms: up.at_worst_ms + down.at_worst_ms,
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::{Jitter, Profile};

    #[test]
    fn jitter_moments_match_the_samples() {
        let jitters = [
            Jitter::Uniform { reach_ms: 10.0 },
            Jitter::Normal { deviation_ms: 3.0 },
            Jitter::Gamma {
                mean_ms: 5.0,
                deviation_ms: 4.0,
            },
            Jitter::Pareto {
                scale_ms: 8.0,
                exponent: 6.0,
            },
        ];
        for jitter in jitters {
            let mut rng = Pcg64::seed_from_u64(1);
            let drawn: Vec<f64> = (0..200_000).map(|_| jitter.draw_ms(&mut rng)).collect();
            let mean = drawn.iter().sum::<f64>() / drawn.len() as f64;
            let square = drawn.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
            let deviation = (square / drawn.len() as f64).sqrt();
            let (m, d) = jitter.moments_ms();
            assert!((mean - m).abs() < 0.1, "{jitter:?}: {mean}, not {m}");
            assert!(
                (deviation - d).abs() < 0.15,
                "{jitter:?}: {deviation}, not {d}"
            );
        }
    }

    #[test]
    fn round_trip_adds_means_and_variances() {
        let t = Profile::named("transatlantic").unwrap();
        assert!(t.is_steady());
        let r = t.round_trip();
        assert!((r.mean_ms - 120.0).abs() < 1e-9);
        assert!((r.deviation_ms - 10.0 * (2.0f64 / 3.0).sqrt()).abs() < 1e-9);
        assert_eq!(r.at_worst_ms, 0.0);
        for (name, at_worst_ms) in [
            ("bursts", 140.0),
            ("far-steps", 180.0),
            ("outages", f64::INFINITY),
        ] {
            let profile = Profile::named(name).unwrap();
            assert!(!profile.is_steady(), "{name}");
            assert_eq!(profile.round_trip().at_worst_ms, at_worst_ms, "{name}");
        }
    }
}
