//! Deadlines of the ticks.

use palpate_protocol::{ClientTime, Span};

/// Absolute deadlines on a fixed grid. A tick that ends after later deadlines skips them: a burst of ticks would give
/// the hand one force for two times. If the clock is set back, the grid restarts.
#[derive(Debug, Clone, Copy)]
pub struct Pace {
    period: Span,
    deadline: ClientTime,
    missed: u64,
}

impl Pace {
    /// The first deadline is one `period` after `now`.
    pub fn new(now: ClientTime, period: Span) -> Self {
        Self {
            period,
            deadline: now + period,
            missed: 0,
        }
    }

    /// Deadline of the next tick.
    pub fn deadline(&self) -> ClientTime {
        self.deadline
    }

    /// Number of deadlines skipped so far.
    pub fn missed(&self) -> u64 {
        self.missed
    }

    /// Ends the current tick at `now`.
    pub fn done(&mut self, now: ClientTime) {
        self.deadline = self.deadline + self.period;
        let over = (now - self.deadline).as_micros();
        if over >= 0 {
            let skipped = over / self.period.as_micros() + 1;
            self.missed += skipped as u64;
            self.deadline = self.deadline + Span::from_micros(skipped * self.period.as_micros());
        }
        self.deadline = self.deadline.min(now + self.period);
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::{ClientTime, Span};

    use super::Pace;

    fn at(us: i64) -> ClientTime {
        ClientTime::from_micros(us)
    }

    #[test]
    fn punctual_loop_keeps_its_grid() {
        let mut pace = Pace::new(at(500), Span::from_millis(1));
        for i in 1..100 {
            assert_eq!(pace.deadline(), at(500 + i * 1000));
            pace.done(at(500 + i * 1000 + (i * 37) % 999));
        }
        assert_eq!(pace.missed(), 0);
    }

    #[test]
    fn late_loop_skips_to_next_deadline() {
        let mut pace = Pace::new(at(0), Span::from_millis(1));
        pace.done(at(4_300));
        assert_eq!((pace.deadline(), pace.missed()), (at(5_000), 3));
        pace.done(at(6_000));
        assert_eq!((pace.deadline(), pace.missed()), (at(7_000), 4));
    }

    #[test]
    fn grid_restarts_when_clock_is_set_back() {
        let mut pace = Pace::new(at(9_000_000), Span::from_millis(1));
        pace.done(at(9_001_100));
        pace.done(at(4_000_000));
        assert_eq!((pace.deadline(), pace.missed()), (at(4_001_000), 0));
    }
}
