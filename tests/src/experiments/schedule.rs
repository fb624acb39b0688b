//! Progress of a list of experiments and the estimated remaining time.

/// Limits of the machine's speed factor; values outside are disturbances of the first parts.
const FACTOR: (f64, f64) = (0.2, 20.0);

/// Minimum remaining share of the running experiment, if it takes longer than expected.
const LEFT_MIN: f64 = 0.05;
const BAR: usize = 20;

#[derive(Debug, Clone)]
pub struct Schedule {
    expected_s: Vec<f64>,
    done: usize,
    took_s: f64,
}

impl Schedule {
    /// A schedule of experiments with these durations on another machine, s, in order.
    pub fn new(expected_s: Vec<f64>) -> Self {
        Self {
            expected_s,
            done: 0,
            took_s: 0.0,
        }
    }

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
    use super::Schedule;
    use crate::experiments::registry::{ALL, BENCHMARKS};

    #[test]
    fn all_experiments_take_less_than_twelve_minutes() {
        let all = ALL.iter().chain(BENCHMARKS);
        assert!(all.map(|e| e.took_s).sum::<f64>() < 720.0);
    }

    #[test]
    fn half_the_machine_speed_doubles_the_remaining_time() {
        let mut schedule = Schedule::new(vec![6.3, 4.6, 20.0]);
        assert!((schedule.left_s(0.0) - (6.3 + 4.6 + 20.0)).abs() < 1e-9);
        schedule.done(2.0 * 6.3);
        assert!((schedule.left_s(0.0) - 2.0 * (4.6 + 20.0)).abs() < 1e-9);
    }

    #[test]
    fn remaining_time_is_positive_until_all_experiments_are_done() {
        let mut schedule = Schedule::new(vec![6.3, 4.6]);
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
        assert!(Schedule::new(Vec::new()).line(0.0).contains("0 of 0"));
    }
}
