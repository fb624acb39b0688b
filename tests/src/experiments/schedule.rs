//! Progress of a list of experiments and the estimated remaining time.

/// Durations of the experiments on two idle cores, s. They are CPU
/// time, or wall time for real-time experiments. Only ratios matter, because completed parts calibrate the
/// machine's speed.
const TOOK_S: &[(&str, f64)] = &[
    ("soft-hard", 1.0),
    ("friction", 6.3),
    ("handle", 4.6),
    ("tool-paths", 164.0),
    ("leg-press", 11.5),
    ("press", 135.0),
    ("atc-none", 6.1),
    ("atc-fixed", 6.4),
    ("atc-adaptive", 7.1),
    ("atc-predicted", 7.7),
    ("transmission", 1.1),
    ("jitter", 1.3),
    ("replicas", 185.0),
    ("thin", 1.5),
    ("scale", 45.0),
    ("table-7-1", 3.5),
    ("missing-data", 0.1),
    ("coding", 0.4),
    ("bytes", 69.0),
    ("haptic-tick", 2.6),
    ("press-cube", 1.1),
    ("haptic-faults", 12.0),
    ("attack", 40.0),
];

/// Assumed duration of an unlisted experiment, s.
const OTHER_S: f64 = 20.0;

/// Limits of the machine's speed factor; values outside are disturbances of the first parts.
const FACTOR: (f64, f64) = (0.2, 20.0);

/// Minimum remaining share of the running experiment, if it takes longer than expected.
const LEFT_MIN: f64 = 0.05;

/// Width of the progress bar in characters.
const BAR: usize = 20;

/// A list of experiments that run one after the other.
#[derive(Debug, Clone)]
pub struct Schedule {
    expected_s: Vec<f64>,
    done: usize,
    took_s: f64,
}

impl Schedule {
    /// A schedule of the named experiments in order.
    pub fn new<'a>(names: impl IntoIterator<Item = &'a str>) -> Self {
        let expected = |name: &str| {
            let listed = TOOK_S.iter().find(|(n, _)| *n == name);
            listed.map_or(OTHER_S, |(_, s)| *s)
        };
        Self {
            expected_s: names.into_iter().map(expected).collect(),
            done: 0,
            took_s: 0.0,
        }
    }

    /// Marks the next experiment as completed after `took_s`.
    pub fn done(&mut self, took_s: f64) {
        self.done = (self.done + 1).min(self.expected_s.len());
        self.took_s += took_s;
    }

    /// Remaining time after the current experiment has run for `running_s`, s.
    pub fn left_s(&self, running_s: f64) -> f64 {
        let (done, rest) = self.expected_s.split_at(self.done);
        let expected: f64 = done.iter().sum();
        let factor = if expected > 0.0 {
            (self.took_s / expected).clamp(FACTOR.0, FACTOR.1)
        } else {
            1.0
        };
        let Some((present, later)) = rest.split_first() else {
            return 0.0;
        };
        let present = factor * present;
        (present - running_s).max(LEFT_MIN * present) + factor * later.iter().sum::<f64>()
    }

    /// Progress bar, number of completed experiments and remaining time.
    pub fn line(&self, running_s: f64) -> String {
        let left_s = self.left_s(running_s);
        let spent_s = self.took_s + running_s;
        let share = spent_s / (spent_s + left_s).max(f64::MIN_POSITIVE);
        let full = ((share * BAR as f64) as usize).min(BAR);
        let left = if left_s < 90.0 {
            format!("{left_s:.0} s")
        } else {
            format!("{:.0} min", left_s / 60.0)
        };
        format!(
            "[{}{}] {} of {} done, about {left} left",
            "#".repeat(full),
            "-".repeat(BAR - full),
            self.done,
            self.expected_s.len()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::{OTHER_S, Schedule, TOOK_S};
    use crate::experiments::benches::BENCHMARKS;
    use crate::experiments::registry::ALL;

    #[test]
    fn all_experiments_are_listed_and_take_less_than_twelve_minutes() {
        let names = ALL.iter().map(|e| e.name);
        for name in names.chain(BENCHMARKS.iter().map(|(b, _)| b.name)) {
            assert!(TOOK_S.iter().any(|(n, _)| *n == name), "{name}");
        }
        assert!(TOOK_S.iter().map(|(_, s)| s).sum::<f64>() < 720.0);
    }

    #[test]
    fn half_the_machine_speed_doubles_the_remaining_time() {
        let mut schedule = Schedule::new(["friction", "handle", "unheard-of"]);
        assert!((schedule.left_s(0.0) - (6.3 + 4.6 + OTHER_S)).abs() < 1e-9);
        schedule.done(2.0 * 6.3);
        assert!((schedule.left_s(0.0) - 2.0 * (4.6 + OTHER_S)).abs() < 1e-9);
    }

    #[test]
    fn remaining_time_is_positive_until_all_experiments_are_done() {
        let mut schedule = Schedule::new(["friction", "handle"]);
        assert!(schedule.left_s(1e6) > 0.0 && schedule.line(1e6).contains("0 of 2 done"));
        schedule.done(1.0);
        schedule.done(1.0);
        schedule.done(1.0);
        assert!(
            schedule.left_s(0.0) == 0.0 && schedule.line(0.0).starts_with("[####################]")
        );
    }

    #[test]
    fn empty_schedule_is_done() {
        assert!(Schedule::new([]).line(0.0).contains("0 of 0"));
    }
}
