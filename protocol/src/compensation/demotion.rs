//! Demotion to spectator of participants whose network needs a longer delay than the cap.

use super::CAP_DEFAULT;
use crate::{ServerTime, Span};

/// A participant is demoted after this long beyond the cap. A burst of a radio link is over by then, and
/// until then the other sites hold the tool still.
pub const DEMOTE_AFTER: Span = Span::from_millis(3000);

/// A participant is restored after this long below the restore threshold: longer than [`DEMOTE_AFTER`],
/// so that an intermittent path does not toggle the role.
pub const RESTORE_AFTER: Span = Span::from_millis(10_000);

/// The restore threshold as a share of the cap.
pub const RESTORE_SHARE: f64 = 0.9;

/// Older reports are ignored; no decision is made until the next report.
pub const REPORT_OLD: Span = Span::from_millis(2000);

/// The server's decision about a participant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DemotionDecision {
    /// The participant becomes a spectator: the delay estimate `wanted` is above the `cap`.
    Demote {
        /// The participant's delay estimate.
        wanted: Span,
        /// The largest delay of the session.
        cap: Span,
    },
    /// The network has recovered: the participant gets the tool back.
    Restore,
}

/// The decision about one participant. Calling order: [`handle_wanted`](Self::handle_wanted) with every
/// report, also during demotion. The owner of the roles applies its result.
#[derive(Debug, Clone)]
pub struct Demotion {
    cap: Span,
    demoted: bool,
    /// Since when the reports have contradicted the current role.
    since: Option<ServerTime>,
    last: Option<ServerTime>,
    demotions: u64,
}

impl Default for Demotion {
    fn default() -> Self {
        Self::new(CAP_DEFAULT)
    }
}

impl Demotion {
    /// A participant that is not demoted.
    pub fn new(cap: Span) -> Self {
        Self {
            cap,
            demoted: false,
            since: None,
            last: None,
            demotions: 0,
        }
    }

    /// Changes the largest delay of the session.
    pub fn set_cap(&mut self, cap: Span) {
        self.cap = cap;
    }

    /// Ends a demotion at once, because the session no longer has a cap. Returns whether there was one.
    pub fn end(&mut self) -> bool {
        self.since = None;
        std::mem::take(&mut self.demoted)
    }

    /// Takes a report and returns the decision, if any.
    pub fn handle_wanted(&mut self, wanted: Span, now: ServerTime) -> Option<DemotionDecision> {
        if self.last.is_some_and(|last| now - last > REPORT_OLD) {
            self.since = None;
        }
        self.last = Some(now);
        let restore_at_us = (self.cap.as_micros() as f64 * RESTORE_SHARE) as i64;
        let contradicts = if self.demoted {
            wanted.as_micros() <= restore_at_us
        } else {
            wanted > self.cap
        };
        if !contradicts {
            self.since = None;
            return None;
        }
        let since = *self.since.get_or_insert(now);
        let waiting_time = if self.demoted {
            RESTORE_AFTER
        } else {
            DEMOTE_AFTER
        };
        if now - since < waiting_time {
            return None;
        }
        self.since = None;
        self.demoted = !self.demoted;
        if self.demoted {
            self.demotions += 1;
            let cap = self.cap;
            Some(DemotionDecision::Demote { wanted, cap })
        } else {
            Some(DemotionDecision::Restore)
        }
    }

    /// Whether the participant is demoted. The group's delay then ignores their reports.
    pub fn is_demoted(&self) -> bool {
        self.demoted
    }

    /// The number of demotions.
    pub fn demotions(&self) -> u64 {
        self.demotions
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reports four times a second.
    fn feed(
        demotion: &mut Demotion,
        from_s: i64,
        until_s: i64,
        ms: i64,
    ) -> Vec<(i64, DemotionDecision)> {
        let quarters = from_s * 4..until_s * 4;
        let verdicts = quarters.filter_map(|i| {
            let now = ServerTime::from_micros(i * 250_000);
            let verdict = demotion.handle_wanted(Span::from_millis(ms), now);
            verdict.map(|v| (i / 4, v))
        });
        verdicts.collect()
    }

    #[test]
    fn demotion_after_three_seconds_and_restoration_after_ten() {
        let mut demotion = Demotion::default();
        assert_eq!(feed(&mut demotion, 0, 2, 600), [], "a burst");
        assert_eq!(feed(&mut demotion, 2, 20, 390), []);
        let verdicts = feed(&mut demotion, 20, 30, 600);
        let (wanted, cap) = (Span::from_millis(600), CAP_DEFAULT);
        assert_eq!(verdicts, [(23, DemotionDecision::Demote { wanted, cap })]);
        assert_eq!(feed(&mut demotion, 30, 60, 390), [], "not yet well enough");
        assert_eq!(feed(&mut demotion, 60, 69, 300), []);
        assert_eq!(
            feed(&mut demotion, 69, 75, 300),
            [(70, DemotionDecision::Restore)]
        );
        assert!(!demotion.is_demoted());
        assert_eq!(demotion.demotions(), 1);
    }

    proptest! {
        #[test]
        fn role_never_toggles_faster_than_both_waiting_times(
            wanted in prop::collection::vec(0_i64..1000, 1..400),
        ) {
            let mut demotion = Demotion::default();
            let mut last: Option<(ServerTime, DemotionDecision)> = None;
            for (i, ms) in wanted.into_iter().enumerate() {
                let now = ServerTime::from_micros(i as i64 * 250_000);
                if let Some(verdict) = demotion.handle_wanted(Span::from_millis(ms), now) {
                    if let Some((at, before)) = last {
                        prop_assert!(now - at >= DEMOTE_AFTER);
                        prop_assert_ne!(before == DemotionDecision::Restore, verdict == DemotionDecision::Restore);
                    }
                    last = Some((now, verdict));
                }
            }
        }
    }
}
