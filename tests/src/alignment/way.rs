//! Packet delays of simulated paths.

use rand::RngExt;
use rand_pcg::Pcg64;

/// A one-way path.
pub trait Way {
    /// One-way delay in microseconds of the next packet, sent at a true time; `None` means lost.
    fn delay_us(&mut self, sent_us: i64) -> Option<i64>;
}

/// Known delay laws of one path. The path from site to site consists of two such paths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Law {
    /// 25 ms plus an exponential of mean 5 ms; from site to site 50 ms and gamma jitter of shape 2.
    Gamma,
    /// From site to site 30, 80 and 120 ms for ten seconds each, with 0.5 ms of gamma jitter.
    Steps,
    /// From site to site 50 ms, with occasional bursts of 120 ms that last 0.1 to 0.4 s.
    Bursts,
    /// 120 ms, uniform jitter of 15 ms and 2 % loss on each path to or from the server.
    Intercontinental,
}

impl Law {
    /// All laws.
    pub const ALL: [Self; 4] = [
        Self::Gamma,
        Self::Steps,
        Self::Bursts,
        Self::Intercontinental,
    ];

    /// Name of the law.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gamma => "gamma",
            Self::Steps => "steps",
            Self::Bursts => "bursts",
            Self::Intercontinental => "two-oceans",
        }
    }

    /// The law with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|l| l.name() == name)
    }
}

/// A path with a delay law.
#[derive(Debug, Clone)]
pub struct LawfulWay {
    law: Law,
    rng: Pcg64,
    bursts_us: Vec<(i64, i64)>,
}

impl LawfulWay {
    /// A path for a session of `lasts_us`. All paths of a session share `air`, so their bursts coincide.
    pub fn new(law: Law, rng: Pcg64, mut air: Pcg64, lasts_us: i64) -> Self {
        let mut bursts_us = Vec::new();
        let mut at = 0;
        while at < lasts_us {
            at += air.random_range(1_000_000..4_000_000);
            let until = at + air.random_range(100_000..400_000);
            bursts_us.push((at, until));
            at = until;
        }
        Self {
            law,
            rng,
            bursts_us,
        }
    }

    fn exponential_us(&mut self, mean_us: f64) -> i64 {
        let u: f64 = self.rng.random_range(f64::MIN_POSITIVE..1.0);
        (-mean_us * u.ln()) as i64
    }
}

impl Way for LawfulWay {
    fn delay_us(&mut self, sent_us: i64) -> Option<i64> {
        match self.law {
            Law::Gamma => Some(25_000 + self.exponential_us(5000.0)),
            Law::Steps => {
                let base = [15_000, 40_000, 60_000][(sent_us / 10_000_000).rem_euclid(3) as usize];
                Some(base + self.exponential_us(250.0))
            }
            Law::Bursts => {
                let next = self.bursts_us.partition_point(|b| b.1 <= sent_us);
                let in_burst = self.bursts_us.get(next).is_some_and(|b| b.0 <= sent_us);
                let base = if in_burst { 60_000 } else { 25_000 };
                Some(base + self.exponential_us(500.0))
            }
            Law::Intercontinental => {
                let lost = self.rng.random::<f64>() < 0.02;
                let delay_us = 120_000 + self.rng.random_range(-15_000..15_000);
                (!lost).then_some(delay_us)
            }
        }
    }
}
