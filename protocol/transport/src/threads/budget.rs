//! CPU budget of a real-time thread: a constant bandwidth server.
//!
//! A thread may use `runtime` of CPU time in every `period`. Work beyond it is a debt: the thread rests until enough
//! periods have passed to pay for it. Over any interval of length L the thread therefore uses at most
//! `runtime · (L / period + 1)` plus one overrun (Abeni and Buttazzo, "Integrating multimedia applications in hard
//! real-time systems", RTSS 1998; the rule for hard reservations).

use palpate_protocol::Span;

/// See the module. Pure: times are arguments, in microseconds of any clock that does not run backwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CpuBudget {
    /// `None`: without a limit.
    limit: Option<Limit>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(clippy::struct_field_names, reason = "names carry their unit")]
struct Limit {
    runtime_us: i64,
    period_us: i64,
    /// CPU time left in this period; negative while there is a debt.
    left_us: i64,
    /// When the period ends; `None` before the first charge.
    ends_us: Option<i64>,
}

impl CpuBudget {
    /// A full budget of `runtime` in every `period`.
    pub fn new(runtime: Span, period: Span) -> Self {
        let runtime_us = runtime.as_micros().max(1);
        Self {
            limit: Some(Limit {
                runtime_us,
                period_us: period.as_micros().max(1),
                left_us: runtime_us,
                ends_us: None,
            }),
        }
    }

    /// A budget that is never spent.
    pub fn unlimited() -> Self {
        Self { limit: None }
    }

    /// Charges `used` CPU time at `now`. Returns how long the thread has to rest: zero while the budget lasts.
    pub fn charge(&mut self, now_us: i64, used: Span) -> Span {
        let Some(limit) = &mut self.limit else {
            return Span::ZERO;
        };
        // Up to the beginning of the work unused time is lost; periods that end during the work count.
        limit.replenish(now_us - used.as_micros());
        limit.left_us -= used.as_micros();
        limit.replenish(now_us);
        limit.rest(now_us)
    }
}

impl Limit {
    /// Adds one runtime for every period that has passed. Time that was not used is not saved up.
    fn replenish(&mut self, now_us: i64) {
        let ends_us = *self.ends_us.get_or_insert(now_us + self.period_us);
        if now_us < ends_us {
            return;
        }
        let periods = (now_us - ends_us) / self.period_us + 1;
        let earned_us = self.runtime_us.saturating_mul(periods);
        self.left_us = self.left_us.saturating_add(earned_us).min(self.runtime_us);
        self.ends_us = Some(ends_us + periods * self.period_us);
    }

    fn rest(&self, now_us: i64) -> Span {
        if self.left_us > 0 {
            return Span::ZERO;
        }
        // The replenishments until the budget is positive.
        let more = -self.left_us / self.runtime_us;
        let ends_us = self.ends_us.unwrap_or(now_us) + more * self.period_us;
        Span::from_micros((ends_us - now_us).max(0))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RUNTIME: Span = Span::from_millis(2);
    const PERIOD: Span = Span::from_millis(4);

    #[test]
    fn a_thread_within_its_budget_never_rests() {
        let mut budget = CpuBudget::new(RUNTIME, PERIOD);
        for turn in 0..1000 {
            let rest = budget.charge(turn * 4000, Span::from_micros(1999));
            assert_eq!(rest, Span::ZERO, "turn {turn}");
        }
    }

    #[test]
    fn overrun_is_followed_by_rest() {
        let mut budget = CpuBudget::new(RUNTIME, PERIOD);
        budget.charge(0, Span::ZERO);
        // 9 ms of work are 4.5 runtimes: the first and those of the periods that end at 4, 8, 12 and 16 ms pay for it.
        let rest = budget.charge(9000, Span::from_micros(9000));
        assert_eq!(9000 + rest.as_micros(), 16_000);
        assert_eq!(budget.charge(16_000, Span::ZERO), Span::ZERO);
    }

    #[test]
    fn idle_time_gives_no_credit() {
        let mut budget = CpuBudget::new(RUNTIME, PERIOD);
        budget.charge(0, Span::ZERO);
        let rest = budget.charge(1_009_000, Span::from_micros(9000));
        assert!(rest >= Span::from_millis(4), "{rest:?}");
    }

    proptest! {
        /// The law of a hard reservation, over every interval between two turns.
        #[test]
        fn any_interval_holds_at_most_its_share_and_one_overrun(
            work in prop::collection::vec((0_i64..20_000, 0_i64..10_000), 1..200),
        ) {
            let mut budget = CpuBudget::new(RUNTIME, PERIOD);
            let mut now = budget.charge(0, Span::ZERO).as_micros();
            let mut turns: Vec<(i64, i64, i64)> = Vec::new();
            for (used, idle) in work {
                let began = now;
                now += used;
                turns.push((began, now, used));
                now += budget.charge(now, Span::from_micros(used)).as_micros() + idle;
            }
            let overrun = turns.iter().map(|t| t.2).max().unwrap_or(0);
            for (i, first) in turns.iter().enumerate() {
                let mut sum = 0;
                for last in &turns[i..] {
                    sum += last.2;
                    let periods = (last.1 - first.0) / 4000 + 2;
                    prop_assert!(sum <= 2000 * periods + overrun);
                }
            }
        }
    }
}
