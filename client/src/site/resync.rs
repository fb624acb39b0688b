//! When one's own copy is to be made anew from the server's log.
//!
//! ```text
//! a node of the view off by > 0.05 mm    the correction is blended in (view.rs)        always
//! by > 0.5 mm in every comparison of 1 s the corrections do not help: a new copy       at most 3 in 60 s
//! another topology                       a new copy at once; again within 60 s: the end
//! ```
//!
//! The rule is of our own making. Pure: no clock.

use std::collections::VecDeque;

use palpate_protocol::{ClientTime, ServerTime, Span};

/// A node farther from where the server has it is beyond what corrections may leave, m: five times what
/// two views may disagree by.
pub const DRIFT_MAX_M: f64 = 0.5e-3;

/// So long the corrections may try. They take three tenths of a difference away, ten times a second:
/// after 1 s what they can take away is below a thirtieth.
pub(super) const DRIFT_PATIENCE: Span = Span::from_millis(1000);

/// Two comparisons that lie farther apart are not one after the other: five of the server's rounds.
const COMPARED_WITHIN: Span = Span::from_millis(500);

/// Copies made anew in `WINDOW` at most. Each costs the whole log and a second without force; what three
/// did not cure, a fourth does not either.
pub const RESYNCS_MAX: usize = 3;

/// What [`RESYNCS_MAX`] is counted in. A topology that differs for the second time in it is a fault that
/// repeats itself.
pub(super) const WINDOW: Span = Span::from_millis(60_000);

/// The decision about one site's copy.
#[derive(Debug, Clone, Default)]
pub(super) struct Resync {
    /// The first and the newest view of a row of comparisons that all were beyond the limit.
    drifting: Option<(ServerTime, ServerTime)>,
    /// When a copy was made anew; at most [`RESYNCS_MAX`].
    made: VecDeque<ClientTime>,
    differed: Option<ClientTime>,
    was_refused: bool,
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Nothing.
    GoOn,
    /// Make the copy anew.
    Anew,
    /// It would be time to, but that was done too often; said once.
    TooOften,
}

impl Resync {
    /// The view of a moment was so far from the server's, m.
    pub(super) fn handle_drift(
        &mut self,
        view: ServerTime,
        max_m: f64,
        now: ClientTime,
    ) -> Verdict {
        // What is no number is beyond every limit.
        if max_m <= DRIFT_MAX_M {
            self.drifting = None;
            return Verdict::GoOn;
        }
        let row = self.drifting.filter(|(_, newest)| {
            let since = view - *newest;
            (Span::ZERO..=COMPARED_WITHIN).contains(&since)
        });
        let first = row.map_or(view, |(first, _)| first);
        self.drifting = Some((first, view));
        if view - first < DRIFT_PATIENCE {
            return Verdict::GoOn;
        }
        self.drifting = None;
        if self.may_resync(now) {
            return Verdict::Anew;
        }
        if std::mem::replace(&mut self.was_refused, true) {
            Verdict::GoOn
        } else {
            Verdict::TooOften
        }
    }

    /// The topology is not the server's. Whether a new copy may be made of it; else it is the end.
    pub(super) fn handle_difference(&mut self, now: ClientTime) -> bool {
        let is_again = self.differed.is_some_and(|at| now - at < WINDOW);
        self.differed = Some(now);
        !is_again
    }

    /// What was compared until now says nothing of what comes.
    pub(super) fn restart(&mut self) {
        self.drifting = None;
    }

    /// A copy was made anew.
    pub(super) fn note(&mut self, now: ClientTime) {
        self.restart();
        if self.made.len() == RESYNCS_MAX {
            self.made.pop_front();
        }
        self.made.push_back(now);
        self.was_refused = false;
    }

    fn may_resync(&self, now: ClientTime) -> bool {
        let recent = self.made.iter().filter(|at| now - **at < WINDOW);
        recent.count() < RESYNCS_MAX
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn view(ms: i64) -> ServerTime {
        ServerTime::from_micros(ms * 1000)
    }

    fn at(ms: i64) -> ClientTime {
        ClientTime::from_micros(ms * 1000)
    }

    /// Comparisons ten times a second; when it asked for a new copy.
    fn asked(resync: &mut Resync, from_ms: i64, until_ms: i64, max_m: f64) -> Vec<i64> {
        let times = (from_ms..until_ms).step_by(100);
        times
            .filter(|t| resync.handle_drift(view(*t), max_m, at(*t)) == Verdict::Anew)
            .collect()
    }

    #[test]
    fn a_drift_that_lasts_for_a_second_asks_and_one_that_corrections_cure_does_not() {
        let mut resync = Resync::default();
        assert_eq!(asked(&mut resync, 0, 1000, 0.6e-3), [0; 0]);
        assert_eq!(asked(&mut resync, 1000, 1100, 0.4e-3), [0; 0]);
        assert_eq!(asked(&mut resync, 1100, 2050, 0.6e-3), [0; 0]);
        assert_eq!(asked(&mut resync, 2100, 2200, 0.6e-3), [2100]);
    }

    #[test]
    fn comparisons_far_apart_are_no_row() {
        let mut resync = Resync::default();
        for t in (0..60_000).step_by(600) {
            assert_eq!(resync.handle_drift(view(t), 1.0, at(t)), Verdict::GoOn);
        }
    }

    #[test]
    fn a_topology_that_differs_twice_in_a_minute_is_the_end() {
        let mut resync = Resync::default();
        assert!(resync.handle_difference(at(0)));
        assert!(!resync.handle_difference(at(59_999)));
        assert!(resync.handle_difference(at(120_000)));
    }

    #[test]
    fn a_number_that_is_none_is_a_drift() {
        let mut resync = Resync::default();
        assert_eq!(asked(&mut resync, 0, 1100, f64::NAN), [1000]);
    }

    proptest! {
        #[test]
        fn in_no_minute_are_there_more_than_the_limit(
            drifts in prop::collection::vec(0.0_f64..3e-3, 10..3000),
        ) {
            let mut resync = Resync::default();
            let mut made: Vec<i64> = Vec::new();
            for (i, max_m) in drifts.into_iter().enumerate() {
                let t = i as i64 * 100;
                // Mostly beyond the limit, or nothing would be asked for.
                if resync.handle_drift(view(t), max_m + 0.49e-3, at(t)) == Verdict::Anew {
                    resync.note(at(t));
                    made.push(t);
                }
            }
            for w in made.windows(RESYNCS_MAX + 1) {
                prop_assert!(w[RESYNCS_MAX] - w[0] >= WINDOW.as_micros() / 1000);
            }
        }
    }
}
