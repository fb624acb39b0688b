//! Policy for resyncs from the server's log.
//!
//! ```text
//! a node of the view off by > 0.05 mm          blend the correction in (view.rs)         always
//! off by > 0.5 mm in all comparisons of 1 s    corrections do not converge: resync       at most 3 in 60 s
//! another topology                             resync at once; again within 60 s: end the session
//! ```
//!
//! Pure: no clock.

use std::collections::VecDeque;

use palpate_protocol::{ClientTime, ServerTime, Span};

/// Node distance from the server beyond which corrections have failed, m: five times the allowed difference of two
/// views.
pub(super) const DRIFT_MAX_M: f64 = 0.5e-3;

/// Time for corrections to converge. They remove 0.3 of a difference ten times a second, so after 1 s less than 1/30
/// of it remains.
pub(super) const DRIFT_PATIENCE: Span = Span::from_millis(1000);

/// Maximum gap within a series of comparisons: five of the server's correction rounds.
const COMPARED_WITHIN: Span = Span::from_millis(500);

/// Maximum number of resyncs in `WINDOW`. Each costs a replay of the log and a second without force; a fourth is as
/// unlikely to help as the three before.
pub const RESYNCS_MAX: usize = 3;

/// Period of [`RESYNCS_MAX`]. A second topology difference within it indicates a reproducible fault.
pub(super) const WINDOW: Span = Span::from_millis(60_000);

/// Resync decisions of one site.
#[derive(Debug, Clone, Default)]
pub(super) struct ResyncPolicy {
    /// First and newest view of a series of comparisons beyond the limit.
    drifting: Option<(ServerTime, ServerTime)>,
    /// Times of resyncs; at most [`RESYNCS_MAX`].
    made: VecDeque<ClientTime>,
    differed: Option<ClientTime>,
    was_refused: bool,
}

/// Decision after a comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ResyncDecision {
    /// No action.
    NoAction,
    /// Request a resync.
    Resync,
    /// A resync would be due, but the limit is reached; reported once.
    TooOften,
}

impl ResyncPolicy {
    /// Processes a comparison of the view at `view_time`: the largest distance to the server, m.
    pub(super) fn handle_drift(
        &mut self,
        view: ServerTime,
        max_m: f64,
        now: ClientTime,
    ) -> ResyncDecision {
        // NaN exceeds every limit.
        if max_m <= DRIFT_MAX_M {
            self.drifting = None;
            return ResyncDecision::NoAction;
        }
        let row = self.drifting.filter(|(_, newest)| {
            let since = view - *newest;
            (Span::ZERO..=COMPARED_WITHIN).contains(&since)
        });
        let first = row.map_or(view, |(first, _)| first);
        self.drifting = Some((first, view));
        if view - first < DRIFT_PATIENCE {
            return ResyncDecision::NoAction;
        }
        self.drifting = None;
        if self.may_resync(now) {
            return ResyncDecision::Resync;
        }
        if std::mem::replace(&mut self.was_refused, true) {
            ResyncDecision::NoAction
        } else {
            ResyncDecision::TooOften
        }
    }

    /// Handles a different topology. Returns whether a resync is allowed; otherwise the session ends.
    pub(super) fn handle_difference(&mut self, now: ClientTime) -> bool {
        let is_again = self.differed.is_some_and(|at| now - at < WINDOW);
        self.differed = Some(now);
        !is_again
    }

    /// Discards the series of comparisons.
    pub(super) fn restart(&mut self) {
        self.drifting = None;
    }

    /// Counts a resync.
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

    /// Feeds comparisons ten times a second; returns the times of resync requests.
    fn resync_times(
        resync: &mut ResyncPolicy,
        from_ms: i64,
        until_ms: i64,
        max_m: f64,
    ) -> Vec<i64> {
        let times = (from_ms..until_ms).step_by(100);
        times
            .filter(|t| resync.handle_drift(view(*t), max_m, at(*t)) == ResyncDecision::Resync)
            .collect()
    }

    #[test]
    fn drift_of_one_second_requests_resync() {
        let mut resync = ResyncPolicy::default();
        assert_eq!(resync_times(&mut resync, 0, 1000, 0.6e-3), [0; 0]);
        assert_eq!(resync_times(&mut resync, 1000, 1100, 0.4e-3), [0; 0]);
        assert_eq!(resync_times(&mut resync, 1100, 2050, 0.6e-3), [0; 0]);
        assert_eq!(resync_times(&mut resync, 2100, 2200, 0.6e-3), [2100]);
    }

    #[test]
    fn distant_comparisons_form_no_series() {
        let mut resync = ResyncPolicy::default();
        for t in (0..60_000).step_by(600) {
            assert_eq!(
                resync.handle_drift(view(t), 1.0, at(t)),
                ResyncDecision::NoAction
            );
        }
    }

    #[test]
    fn second_topology_difference_in_window_ends_session() {
        let mut resync = ResyncPolicy::default();
        assert!(resync.handle_difference(at(0)));
        assert!(!resync.handle_difference(at(59_999)));
        assert!(resync.handle_difference(at(120_000)));
    }

    #[test]
    fn nan_drift_exceeds_limit() {
        let mut resync = ResyncPolicy::default();
        assert_eq!(resync_times(&mut resync, 0, 1100, f64::NAN), [1000]);
    }

    proptest! {
        #[test]
        fn resyncs_per_window_are_limited(
            drifts in prop::collection::vec(0.0_f64..3e-3, 10..3000),
        ) {
            let mut resync = ResyncPolicy::default();
            let mut made: Vec<i64> = Vec::new();
            for (i, max_m) in drifts.into_iter().enumerate() {
                let t = i as i64 * 100;
                // Values are mostly beyond the limit, so that requests occur.
                if resync.handle_drift(view(t), max_m + 0.49e-3, at(t)) == ResyncDecision::Resync {
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
