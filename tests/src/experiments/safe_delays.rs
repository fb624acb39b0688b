//! Smallest safe fixed delays, searched once for all experiments of a run.

use std::sync::{Arc, Mutex, PoisonError};

use crate::alignment::Alignment;

struct Found {
    of: Alignment,
    safe_ms: Option<u32>,
}

fn is_same(a: &Alignment, b: &Alignment) -> bool {
    let is_same_motion = match (&a.motion, &b.motion) {
        (Some(a), Some(b)) => Arc::ptr_eq(a, b),
        (a, b) => a.is_none() && b.is_none(),
    };
    (a.seed, &a.profile) == (b.seed, &b.profile) && is_same_motion
}

/// The delays found so far. Clones share them.
#[derive(Clone, Default)]
pub(super) struct SafeDelays(Arc<Mutex<Vec<Found>>>);

impl SafeDelays {
    /// The smallest safe fixed delay of an alignment, if any; `told` receives each tried delay.
    pub(super) fn of(&self, alignment: &Alignment, told: &mut dyn FnMut(u32)) -> Option<u32> {
        let mut found = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = found.iter().find(|f| is_same(&f.of, alignment)) {
            return known.safe_ms;
        }
        let safe_ms = alignment.smallest_safe_fixed_ms(told);
        found.push(Found {
            of: alignment.clone(),
            safe_ms,
        });
        safe_ms
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hand::{Hand, HandParameters, Random};
    use crate::network::Profile;

    #[test]
    fn delay_is_searched_once_per_network_seed_and_motion() {
        let delays = SafeDelays::default();
        let search = |delays: &SafeDelays, name: &str, seed, motion: Option<Arc<dyn Hand>>| {
            let alignment = Alignment {
                profile: Profile::named(name).unwrap(),
                seed,
                motion,
            };
            let mut tried = 0;
            let safe_ms = delays.of(&alignment, &mut |_| tried += 1);
            (safe_ms, tried > 0)
        };
        let first = search(&delays, "lan", 1, None);
        assert!(first.0.is_some() && first.1);
        assert_eq!(search(&delays.clone(), "lan", 1, None), (first.0, false));
        assert!(search(&delays, "lan", 2, None).1);
        let metro = search(&delays, "metro", 1, None);
        assert!(metro.1 && metro.0 > first.0, "{metro:?}");
        let hand: Arc<dyn Hand> = Arc::new(Random::new(HandParameters::default(), 1));
        assert!(search(&delays, "lan", 1, Some(Arc::clone(&hand))).1);
        assert!(!search(&delays, "lan", 1, Some(hand)).1);
    }
}
