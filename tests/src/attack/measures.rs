//! Figures of a session under attack, and their limits relative to the session without one.

use std::time::Duration;

use palpate_client::Recording;
use serde::Serialize;

use super::kinds::{Attack, Counts};
use crate::cpu::CpuRow;
use crate::criteria::{Criterion, DROPOUT_MS};
use crate::delay_figures::DelayFigures;
use crate::memory::Memory;

/// Allowed growth of force error and playout delay D, relative to the run without attack.
const GROWTH: f64 = 1.1;

/// Allowed growth of the force error in a run of 30 s, percentage points, where [`GROWTH`] allows less: two runs
/// differ by that.
const FORCE_FLOOR_PERCENT: f64 = 1.0;

/// The same for a run of this length: the mean of fewer presses and cuts scatters more, with the root of the time.
fn force_floor_percent(seconds: f64) -> f64 {
    FORCE_FLOOR_PERCENT * (30.0 / seconds).sqrt().max(1.0)
}

/// Allowed growth of D, ms, where [`GROWTH`] allows less.
pub(super) const DELAY_FLOOR_MS: f64 = 2.0;

/// Maximum time of a newcomer from the first packet to the complete model, s.
const NEWCOMER_S: f64 = 3.0;

/// Allowed growth of the server's memory, MB, above its growth in the session without attack: a cut of the thigh
/// alone takes 55 MB.
pub(super) const MEMORY_MB: f64 = 64.0;

/// Maximum time from the end of the attack to normal service, s.
const RECOVERED_S: f64 = 2.0;

/// The figures of one run.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Figures {
    /// Names of the attacks; none for the run without attack.
    pub attacks: Vec<&'static str>,
    /// The honest trainees.
    pub hands: Vec<HandFigures>,
    /// Playout delay D during the attack.
    pub delay: Option<DelayFigures>,
    /// Demotions of honest trainees.
    pub demotions: Option<u64>,
    /// Attempts to join during the attack.
    pub newcomers: Newcomers,
    /// Memory of the server.
    pub memory: Option<MemoryFigures>,
    /// The time after the attack.
    pub recovery: Recovery,
    /// Strokes of the honest scripts, and cuts by honest trainees in the log.
    pub strokes: u64,
    /// See [`strokes`](Self::strokes).
    pub honest_cuts: Option<u64>,
    /// Operations that the observer received.
    pub operations: Option<u64>,
    /// CPU time of the server; `None` if it failed.
    pub server_cpu: Option<CpuRow>,
    /// Counters of each attack.
    pub achieved: Vec<(&'static str, Counts)>,
    /// Processes that failed, one sentence each.
    pub problems: Vec<String>,
}

/// The force on an honest trainee.
#[derive(Debug, Clone, Default, Serialize)]
pub struct HandFigures {
    /// The trainee.
    pub name: &'static str,
    /// Error of the force against the same hands without a network, percent rms.
    pub force_error_percent: Option<f64>,
    /// Number of dropouts.
    pub dropouts: Option<usize>,
    /// Longest dropout, ms.
    pub longest_dropout_ms: Option<f64>,
}

/// Attempts to join during an attack.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Newcomers {
    /// Attempts.
    pub attempts: usize,
    /// Complete joins among them.
    pub joined: usize,
    /// Longest time of a complete join with its model, s.
    pub slowest_s: Option<f64>,
    /// The reasons of the others, without repetitions.
    pub reasons: Vec<String>,
}

impl Newcomers {
    /// The figures of finished attempts.
    pub(super) fn of<'a>(results: impl IntoIterator<Item = &'a Result<Duration, String>>) -> Self {
        let mut figures = Self::default();
        for result in results {
            figures.attempts += 1;
            match result {
                Ok(took) => {
                    figures.joined += 1;
                    let took_s = took.as_secs_f64();
                    figures.slowest_s = Some(figures.slowest_s.map_or(took_s, |s| s.max(took_s)));
                }
                Err(why) if figures.reasons.contains(why) => {}
                Err(why) => figures.reasons.push(why.clone()),
            }
        }
        figures
    }
}

/// Resident memory of the server, MB.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MemoryFigures {
    /// Before the attack.
    pub quiet_mb: f64,
    /// Largest afterwards.
    pub largest_mb: f64,
}

impl MemoryFigures {
    /// Starts with the memory before the attack.
    pub(super) fn new(quiet: Memory) -> Self {
        Self {
            quiet_mb: quiet.resident_mb,
            largest_mb: quiet.resident_mb,
        }
    }

    /// Adds a later sample. `before` is the sample before the attack: a peak above its peak is new.
    pub(super) fn note(&mut self, sample: Memory, before: Memory) {
        self.largest_mb = self.largest_mb.max(sample.resident_mb);
        if sample.peak_mb > before.peak_mb {
            self.largest_mb = self.largest_mb.max(sample.peak_mb);
        }
    }

    /// The growth since before the attack.
    pub(super) fn growth_mb(&self) -> f64 {
        self.largest_mb - self.quiet_mb
    }
}

/// Times from the end of the attack to normal service, s. A service that did not return has the observed time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Recovery {
    /// Until a newcomer had joined.
    pub newcomer_s: Option<f64>,
    /// Until D was back.
    pub delay_s: Option<f64>,
    /// Until the memory was back.
    pub memory_s: Option<f64>,
}

impl Recovery {
    /// The latest of the three; `None` if one is missing.
    pub(super) fn all_s(&self) -> Option<f64> {
        Some(self.newcomer_s?.max(self.delay_s?).max(self.memory_s?))
    }
}

/// Time from the end of the attack, in µs of the machine's clock, to the last view with D above a limit, s.
/// `None` without later views.
pub(super) fn delay_back_s(recordings: &[&Recording], end_us: i64, limit_ms: f64) -> Option<f64> {
    let views = recordings.iter().flat_map(|r| &r.views);
    let mut later = views.filter(|v| v.shown_us >= end_us).peekable();
    later.peek()?;
    let above = later.filter(|v| v.delay_us as f64 * 1e-3 > limit_ms);
    let last = above.map(|v| v.shown_us - end_us).max();
    Some(last.unwrap_or(0) as f64 * 1e-6)
}

/// The limit for a figure that was `base` without attack.
pub(super) fn limit(base: f64, floor: f64) -> f64 {
    (GROWTH * base).max(base + floor)
}

/// A criterion with a limit relative to the run without attack. Without that figure it fails.
fn relative(
    name: String,
    value: Option<f64>,
    base: Option<f64>,
    floor: f64,
    unit: &str,
) -> Criterion {
    let value = value.filter(|_| base.is_some());
    Criterion::at_most(name, value, base.map_or(0.0, |b| limit(b, floor)), unit)
}

/// The criteria of a run under attack.
pub(super) fn judge(run: &Figures, base: &Figures, seconds: f64) -> Vec<Criterion> {
    let label = run.label();
    let named = |what: &str| format!("{label}: {what}");
    let mut table = Vec::new();
    for name in crate::demo::pair::NAMES {
        let of = |f: &Figures| f.hands.iter().find(|h| h.name == name).cloned();
        let (hand, quiet) = (of(run), of(base));
        table.push(relative(
            named(&format!("force error of the {name}")),
            hand.as_ref().and_then(|h| h.force_error_percent),
            quiet.as_ref().and_then(|h| h.force_error_percent),
            force_floor_percent(seconds),
            "%",
        ));
        let longest_ms = quiet.and_then(|h| h.longest_dropout_ms);
        table.push(Criterion::at_most(
            named(&format!("longest dropout of the {name}")),
            hand.and_then(|h| h.longest_dropout_ms),
            // Attackers are busy processes on the same machine.
            longest_ms.unwrap_or(0.0).max(DROPOUT_MS[1]),
            "ms",
        ));
    }
    let median = |f: &Figures| f.delay.map(|d| d.median_ms);
    let largest = |f: &Figures| f.delay.map(|d| d.max_ms);
    for (what, value, quiet) in [
        ("median playout delay D", median(run), median(base)),
        ("largest playout delay D", largest(run), largest(base)),
    ] {
        table.push(relative(named(what), value, quiet, DELAY_FLOOR_MS, "ms"));
    }
    let newcomers = &run.newcomers;
    let kept_out = (newcomers.attempts - newcomers.joined) as u64;
    table.extend([
        Criterion::none_of(named("demotions of honest trainees"), run.demotions),
        Criterion::none_of(
            named("newcomers that could not join"),
            (newcomers.attempts > 0).then_some(kept_out),
        ),
        Criterion::at_most(
            named("slowest newcomer"),
            newcomers.slowest_s,
            NEWCOMER_S,
            "s",
        ),
        Criterion::at_most(
            named("growth of the server's memory beyond that without attack"),
            (run.memory.zip(base.memory)).map(|(m, quiet)| m.growth_mb() - quiet.growth_mb()),
            MEMORY_MB,
            "MB",
        ),
        Criterion::at_most(
            named("recovered after the end"),
            run.recovery.all_s(),
            RECOVERED_S,
            "s",
        ),
        Criterion::none_of(
            named("lost cuts of honest trainees"),
            run.honest_cuts.map(|n| run.strokes.saturating_sub(n)),
        ),
        Criterion::none_of(
            named("processes that failed"),
            Some(run.problems.len() as u64),
        ),
    ]);
    for (name, counts) in &run.achieved {
        let forbidden = Attack::named(name).map_or(&[][..], |attack| attack.forbidden);
        table.extend(forbidden.iter().map(|what| {
            let count = counts.get(what).copied().unwrap_or(0);
            Criterion::none_of(named(what), Some(count))
        }));
    }
    // The figures of an attack that did nothing are no figures.
    let idle = run.achieved.iter().filter(|(_, counts)| counts.is_empty());
    let idle = (!run.achieved.is_empty()).then(|| idle.count() as u64);
    table.push(Criterion::none_of(named("attacks that did nothing"), idle));
    table
}

impl Figures {
    /// The names of the attacks, or the number of many.
    pub(crate) fn label(&self) -> String {
        match self.attacks.len() {
            0 => "without attack".to_owned(),
            1 | 2 => self.attacks.join(" + "),
            n => format!("{n} attacks at once"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use palpate_client::Recording;
    use palpate_client::recording::ViewRecord;
    use proptest::prelude::*;

    use super::{
        Figures, HandFigures, MemoryFigures, Newcomers, Recovery, delay_back_s, judge, limit,
    };
    use crate::delay_figures::DelayFigures;
    use crate::memory::Memory;

    fn good() -> Figures {
        let hand = |name| HandFigures {
            name,
            force_error_percent: Some(5.0),
            dropouts: Some(0),
            longest_dropout_ms: Some(0.0),
        };
        Figures {
            attacks: vec!["delay"],
            hands: crate::demo::pair::NAMES.map(hand).into(),
            delay: Some(DelayFigures {
                median_ms: 10.0,
                max_ms: 12.0,
            }),
            demotions: Some(0),
            newcomers: Newcomers::of(&[Ok(Duration::from_millis(800))]),
            memory: Some(MemoryFigures {
                quiet_mb: 100.0,
                largest_mb: 120.0,
            }),
            recovery: Recovery {
                newcomer_s: Some(0.5),
                delay_s: Some(0.0),
                memory_s: Some(0.0),
            },
            strokes: 1,
            honest_cuts: Some(1),
            operations: Some(9),
            server_cpu: None,
            achieved: vec![("delay", [("reports sent", 3)].into())],
            problems: Vec::new(),
        }
    }

    fn failed(run: &Figures) -> Vec<String> {
        let judged = judge(run, &good(), 30.0);
        let failed = judged.into_iter().filter(|c| !c.ok);
        failed.map(|c| c.criterion).collect()
    }

    #[test]
    fn a_run_like_the_one_without_attack_passes() {
        assert_eq!(failed(&good()), [""; 0]);
    }

    #[test]
    fn every_missing_figure_fails() {
        let missing = Figures {
            attacks: vec!["delay"],
            ..Figures::default()
        };
        let all = judge(&missing, &good(), 30.0);
        // No process failed, although nothing was measured.
        assert_eq!(all.iter().filter(|c| c.ok).count(), 1, "{all:?}");
        let all = judge(&good(), &Figures::default(), 30.0);
        assert_eq!(all.iter().filter(|c| !c.ok).count(), 5, "{all:?}");
    }

    #[test]
    fn each_figure_beyond_its_limit_fails_alone() {
        type Change = fn(&mut Figures);
        let changes: [(&str, Change); 9] = [
            ("force error of the holder", |f| {
                f.hands[0].force_error_percent = Some(6.1);
            }),
            ("longest dropout of the cutter", |f| {
                f.hands[1].longest_dropout_ms = Some(61.0);
            }),
            ("median playout delay D", |f| {
                f.delay.as_mut().unwrap().median_ms = 12.1;
            }),
            ("demotions of honest trainees", |f| f.demotions = Some(1)),
            ("slowest newcomer", |f| f.newcomers.slowest_s = Some(3.1)),
            ("newcomers that could not join", |f| {
                f.newcomers.attempts = 2;
            }),
            (
                "growth of the server's memory beyond that without attack",
                |f| {
                    f.memory.as_mut().unwrap().largest_mb = 185.0;
                },
            ),
            ("recovered after the end", |f| {
                f.recovery.delay_s = Some(2.1);
            }),
            ("lost cuts of honest trainees", |f| f.honest_cuts = Some(0)),
        ];
        for (what, change) in changes {
            let mut run = good();
            change(&mut run);
            assert_eq!(failed(&run), [format!("delay: {what}")]);
        }
    }

    #[test]
    fn forbidden_events_fail() {
        let mut run = good();
        run.achieved = vec![("names", [("false names accepted", 2)].into())];
        assert_eq!(failed(&run), ["delay: false names accepted"]);
        run.achieved = vec![("pages", [("broken shapes", 1), ("joined", 50)].into())];
        assert_eq!(failed(&run), ["delay: broken shapes"]);
    }

    #[test]
    fn the_slowest_newcomer_and_all_reasons_are_kept() {
        let results = [
            Ok(Duration::from_secs(1)),
            Err("full".to_owned()),
            Ok(Duration::from_secs(2)),
            Err("full".to_owned()),
        ];
        let newcomers = Newcomers::of(&results);
        assert_eq!((newcomers.attempts, newcomers.joined), (4, 2));
        assert_eq!(newcomers.slowest_s, Some(2.0));
        assert_eq!(newcomers.reasons, ["full"]);
    }

    #[test]
    fn a_peak_from_before_the_attack_does_not_count() {
        let at = |resident_mb, peak_mb| Memory {
            resident_mb,
            peak_mb,
        };
        let before = at(100.0, 300.0);
        let mut memory = MemoryFigures::new(before);
        memory.note(at(110.0, 300.0), before);
        assert_eq!(memory.growth_mb(), 10.0);
        memory.note(at(110.0, 310.0), before);
        assert_eq!(memory.growth_mb(), 210.0);
    }

    #[test]
    fn delay_is_back_after_the_last_view_above_the_limit() {
        let view = |shown_us, delay_us| ViewRecord {
            shown_us,
            delay_us,
            ..ViewRecord::default()
        };
        let recording = Recording {
            views: vec![
                view(900_000, 99_000),
                view(1_100_000, 50_000),
                view(1_600_000, 13_000),
                view(1_700_000, 12_000),
            ],
            ..Recording::default()
        };
        let back = |end_us| delay_back_s(&[&recording], end_us, 12.0);
        assert_eq!(back(1_000_000), Some(0.6));
        assert_eq!(back(1_650_000), Some(0.0));
        assert_eq!(back(2_000_000), None);
    }

    proptest! {
        #[test]
        fn limits_allow_a_tenth_and_at_least_the_floor(base in 0.0..500.0f64, floor in 0.0..10.0f64) {
            let limit = limit(base, floor);
            prop_assert!(limit >= 1.1 * base && limit >= base + floor);
            prop_assert!(limit <= 1.1 * base + floor);
        }
    }
}
