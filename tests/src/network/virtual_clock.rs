//! A wrong clock in virtual time.

/// The clock of a simulated site, with offset, drift and steps.
///
/// ```text
/// reading(t) = offset + t (1 + drift) + the steps up to t
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VirtualClock {
    /// Reading at the start of the network, microseconds.
    pub offset_us: i64,
    /// Drift, parts per million; a quartz has up to 100.
    pub drift_ppm: f64,
    /// Steps: true times in microseconds, in increasing order, and the size of each.
    pub steps: Vec<(u64, i64)>,
}

impl VirtualClock {
    /// Reading at a true time, microseconds.
    pub fn reading(&self, true_us: u64) -> i64 {
        let set = self.steps.iter().take_while(|(at, _)| *at <= true_us);
        let set: i64 = set.map(|(_, by)| *by).fold(0, i64::saturating_add);
        self.running(true_us).saturating_add(set)
    }

    /// Reading without steps.
    fn running(&self, true_us: u64) -> i64 {
        let gained = (true_us as f64 * self.drift_ppm * 1e-6).round() as i64;
        self.offset_us
            .saturating_add(i64::try_from(true_us).unwrap_or(i64::MAX))
            .saturating_add(gained)
    }

    /// First true time, not before `from_us`, with a reading of at least `reading`: the wake-up time of a site
    /// that waits on its clock. `None` if that never happens.
    pub fn when(&self, reading: i64, from_us: u64) -> Option<u64> {
        if self.reading(from_us) >= reading {
            return Some(from_us);
        }
        // The clock is linear between steps, so the first interval that reaches the reading is bisected.
        let later = self
            .steps
            .iter()
            .map(|(at, _)| *at)
            .filter(|at| *at > from_us);
        let mut low = from_us;
        for end in later.chain([LAST_US]) {
            let before = end - 1;
            if self.reading(before) >= reading {
                return Some(self.first_within(reading, low, before));
            }
            if self.reading(end) >= reading {
                return Some(end);
            }
            low = end;
        }
        None
    }

    /// First time with at least `reading` in an interval without steps; its end satisfies this.
    fn first_within(&self, reading: i64, mut low: u64, mut high: u64) -> u64 {
        while low + 1 < high {
            let middle = low + (high - low) / 2;
            if self.reading(middle) >= reading {
                high = middle;
            } else {
                low = middle;
            }
        }
        high
    }
}

/// The end of virtual time: a year.
const LAST_US: u64 = 31_536_000_000_000;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn clock_drifts_and_steps() {
        let clock = VirtualClock {
            offset_us: -500,
            drift_ppm: 50.0,
            steps: vec![(2_000_000, 3_600_000_000), (3_000_000, -7_200_000_000)],
        };
        assert_eq!(clock.reading(0), -500);
        assert_eq!(clock.reading(1_000_000), -500 + 1_000_050);
        assert_eq!(clock.reading(2_000_000), -500 + 2_000_100 + 3_600_000_000);
        assert_eq!(clock.reading(4_000_000), -500 + 4_000_200 - 3_600_000_000);
    }

    proptest! {
        #[test]
        fn site_wakes_at_the_first_time_its_clock_reaches_the_reading(
            offset_us in -10_000_000_i64..10_000_000,
            drift_ppm in -500.0..500.0_f64,
            step in (1_u64..5_000_000, -2_000_000_i64..2_000_000),
            from_us in 0_u64..6_000_000,
            wait in 0_i64..4_000_000,
        ) {
            let clock = VirtualClock { offset_us, drift_ppm, steps: vec![step] };
            let reading = clock.reading(from_us) + wait;
            let at = clock.when(reading, from_us).unwrap();
            prop_assert!(at >= from_us);
            prop_assert!(clock.reading(at) >= reading);
            prop_assert!(at == from_us || clock.reading(at - 1) < reading);
        }
    }
}
