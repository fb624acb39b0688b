//! Smallest safe fixed delays, searched once for all experiments of a run.

use std::sync::{Arc, Mutex, PoisonError};

use crate::alignment::Alignment;
use crate::network::Profile;

#[derive(Debug)]
struct Found {
    profile: Profile,
    seed: u64,
    safe_ms: Option<u32>,
}

/// The delays found so far. Clones share them; all experiments of a run have the same hand motion.
#[derive(Debug, Clone, Default)]
pub(super) struct SafeDelays(Arc<Mutex<Vec<Found>>>);

impl SafeDelays {
    /// The smallest safe fixed delay of an alignment, if any; `told` receives each tried delay.
    pub(super) fn of(&self, alignment: &Alignment, told: &mut dyn FnMut(u32)) -> Option<u32> {
        let mut found = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (profile, seed) = (&alignment.profile, alignment.seed);
        if let Some(known) = found
            .iter()
            .find(|f| f.seed == seed && f.profile == *profile)
        {
            return known.safe_ms;
        }
        let safe_ms = alignment.smallest_safe_fixed_ms(told);
        found.push(Found {
            profile: profile.clone(),
            seed,
            safe_ms,
        });
        safe_ms
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_is_searched_once_per_network_and_seed() {
        let delays = SafeDelays::default();
        let search = |delays: &SafeDelays, name: &str, seed| {
            let alignment = Alignment {
                profile: Profile::named(name).unwrap(),
                seed,
                motion: None,
            };
            let mut tried = 0;
            let safe_ms = delays.of(&alignment, &mut |_| tried += 1);
            (safe_ms, tried > 0)
        };
        let first = search(&delays, "lan", 1);
        assert!(first.0.is_some() && first.1);
        assert_eq!(search(&delays.clone(), "lan", 1), (first.0, false));
        assert!(search(&delays, "lan", 2).1);
        let metro = search(&delays, "metro", 1);
        assert!(metro.1 && metro.0 > first.0, "{metro:?}");
    }
}
