//! What happens to a packet, as a pure function of seed, flow, direction and number.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::profile::{Jitter, Profile};

/// Which way a packet goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Direction {
    /// From a client to the server.
    Up,
    /// From the server to a client.
    Down,
}

/// What happens to one packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fate {
    /// How often it arrives: 0 when it is lost, 2 when it is doubled.
    pub copies: u8,
    /// Its delay in microseconds.
    pub delay_us: u64,
}

/// The fates of all packets of a network.
#[derive(Debug, Clone)]
pub struct Fates {
    profile: Profile,
    seed: u64,
}

/// Spreads the bits of a number (the finaliser of splitmix64).
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// What a random stream is for, so that two uses of one number do not share it.
const PACKET: u64 = 1;
const BLOCK: u64 = 2;

impl Fates {
    /// The fates under a profile and a seed.
    pub fn new(profile: Profile, seed: u64) -> Self {
        Self { profile, seed }
    }

    /// The profile.
    pub fn profile(&self) -> &Profile {
        &self.profile
    }

    fn random(&self, flow: u64, direction: Direction, n: u64, purpose: u64) -> Pcg64 {
        let way = match direction {
            Direction::Up => 0x55,
            Direction::Down => 0xaa,
        };
        let key = mix(self.seed ^ mix(flow ^ mix((way << 8) | purpose)));
        Pcg64::seed_from_u64(mix(key ^ n.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// The fate of the `n`-th packet (from 0) of a flow in a direction.
    pub fn fate(&self, flow: u64, direction: Direction, n: u64) -> Fate {
        let mut rng = self.random(flow, direction, n, PACKET);
        let p = &self.profile;
        // Every packet draws the same numbers in the same order, whatever the profile makes of
        // them: changing the loss does not change the delays.
        let (lost, doubled): (f64, f64) = (rng.random(), rng.random());
        let uniform: f64 = rng.random_range(-1.0..1.0);
        let normal = standard_normal(&mut rng);
        let jitter_ms = match p.jitter {
            Jitter::None => 0.0,
            Jitter::Uniform(reach) => reach * uniform,
            Jitter::Normal(deviation) => deviation * normal.clamp(-3.0, 3.0),
        };
        let (mut loss, mut delay_ms) = (p.loss, p.delay_ms + jitter_ms);
        if self.in_burst(flow, direction, n)
            && let Some(bursts) = &p.bursts
        {
            loss = loss.max(bursts.loss);
            delay_ms += bursts.delay_ms;
        }
        let copies = if lost < loss {
            0
        } else {
            1 + u8::from(doubled < p.duplicate)
        };
        Fate {
            copies,
            delay_us: (delay_ms.max(0.0) * 1e3).round() as u64,
        }
    }

    fn in_burst(&self, flow: u64, direction: Direction, n: u64) -> bool {
        let Some(bursts) = &self.profile.bursts else {
            return false;
        };
        let block = bursts.block.max(1);
        let mut rng = self.random(flow, direction, n / block, BLOCK);
        let happens = rng.random::<f64>() < bursts.probability;
        let start = rng.random_range(0..=block.saturating_sub(bursts.length));
        happens && (start..start + bursts.length).contains(&(n % block))
    }
}

/// Box and Muller's transform.
fn standard_normal(rng: &mut Pcg64) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_gives_the_same_fates_in_any_order() {
        let fates = Fates::new(Profile::named("lossy").unwrap(), 7);
        let forwards: Vec<Fate> = (0..500).map(|n| fates.fate(3, Direction::Up, n)).collect();
        let backwards: Vec<Fate> = (0..500)
            .rev()
            .map(|n| fates.clone().fate(3, Direction::Up, n))
            .collect();
        assert!(forwards.iter().eq(backwards.iter().rev()));
        let other = |flow, way, seed| {
            let fates = Fates::new(Profile::named("lossy").unwrap(), seed);
            (0..500)
                .map(|n| fates.fate(flow, way, n))
                .collect::<Vec<_>>()
        };
        assert_ne!(forwards, other(3, Direction::Down, 7));
        assert_ne!(forwards, other(4, Direction::Up, 7));
        assert_ne!(forwards, other(3, Direction::Up, 8));
    }

    #[test]
    fn shares_and_means_are_those_of_the_profile() {
        for name in ["metro", "transatlantic", "lossy", "satellite"] {
            let profile = Profile::named(name).unwrap();
            let fates = Fates::new(profile.clone(), 1);
            let n = 50_000;
            let all: Vec<Fate> = (0..n).map(|i| fates.fate(0, Direction::Down, i)).collect();
            let lost = all.iter().filter(|f| f.copies == 0).count() as f64 / n as f64;
            let doubled = all.iter().filter(|f| f.copies == 2).count() as f64 / n as f64;
            let mean_ms = all.iter().map(|f| f.delay_us as f64).sum::<f64>() / n as f64 / 1e3;
            assert!((lost - profile.loss).abs() < 0.006, "{name}: {lost}");
            assert!(
                (doubled - profile.duplicate).abs() < 0.004,
                "{name}: {doubled}"
            );
            assert!(
                (mean_ms - profile.delay_ms).abs() < 0.2,
                "{name}: {mean_ms}"
            );
        }
    }

    #[test]
    fn bursts_are_bursts() {
        let profile = Profile::named("wifi-bursts").unwrap();
        let bursts = profile.bursts.unwrap();
        let fates = Fates::new(profile, 1);
        let slow = |n: u64| fates.fate(0, Direction::Up, n).delay_us > 45_000;
        let runs = (1..100_000).filter(|n| slow(*n) && !slow(n - 1)).count() as f64;
        let packets = (0..100_000).filter(|n| slow(*n)).count() as f64;
        assert!(
            (packets / runs - bursts.length as f64).abs() < 2.0,
            "{} a burst",
            packets / runs
        );
        assert!((runs / 400.0 - bursts.probability).abs() < 0.1);
    }
}
