//! Converged solves at some moments of a session, and what they say of all others.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};

use palpate_client::Replica;
use palpate_protocol::ClientTime;
use palpate_protocol::operation::Operation;
use palpate_tissue::{Budget, Model};

use super::table::{Solve, pressed};
use super::{Quality, ReferenceError};

/// Relative residual over the whole tissue at which a check ends. With a third of it forces on the thigh change by
/// 0.5 %.
pub(super) const TOLERANCE: f64 = 1e-2;

/// Iterations of a check at most: the tool has jumped since the last one.
const ITERATIONS: usize = 30;

/// Threads that check: each takes a part of the script.
const THREADS: usize = 2;

/// Forces below this say nothing of a ratio, N.
const FORCE_MIN_N: f64 = 0.01;

/// A ratio outside of this is a contact that one of the two solves does not have.
const RATIOS: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// What a check says of one hand.
#[derive(Debug, Clone, Copy)]
#[allow(
    clippy::struct_field_names,
    reason = "the ratio and when it was measured"
)]
struct Ratio {
    us: i64,
    /// Checked force over tracked force.
    ratio: f64,
    /// The tracked force, N.
    force_n: f64,
}

/// The ratios of one hand, in the order of time.
#[derive(Debug, Clone, Default)]
pub(super) struct Ratios(Vec<Ratio>);

/// What all checks say.
pub(super) struct Checked {
    pub(super) ratios: [Ratios; 2],
    pub(super) quality: Quality,
}

/// One check: residual, and what both hands feel.
struct Check {
    residual: f64,
    ratios: [Option<Ratio>; 2],
}

/// Checks `count` of the solves that touch.
pub(super) fn run(
    model: &Arc<Model>,
    solves: &[Solve],
    cuts: &[(i64, Operation)],
    count: usize,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Checked, ReferenceError> {
    let touching: Vec<&Solve> = solves.iter().filter(|s| s.touches()).collect();
    let count = count.min(touching.len());
    // The middles of `count` equal parts.
    let chosen = (0..count).map(|k| touching[(2 * k + 1) * touching.len() / (2 * count)]);
    let chosen: Vec<&Solve> = chosen.collect();
    let stop = AtomicBool::new(false);
    let checks = std::thread::scope(|scope| {
        let (done, told) = channel();
        let parts = chosen.chunks(count.div_ceil(THREADS).max(1)).map(|part| {
            let (done, stop) = (done.clone(), &stop);
            scope.spawn(move || check(model, part, cuts, &done, stop))
        });
        let parts: Vec<_> = parts.collect();
        drop(done);
        for (n, ()) in told.iter().enumerate() {
            if !progress((n + 1) as f64 / count as f64) {
                stop.store(true, Ordering::Relaxed);
            }
        }
        let joined = parts.into_iter().map(|part| {
            part.join()
                .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        });
        joined.collect::<Result<Vec<Vec<Check>>, ReferenceError>>()
    })?;
    let checks: Vec<Check> = checks.into_iter().flatten().collect();
    if checks.len() < count {
        return Err(ReferenceError::Stopped(checks.len() as f64 / count as f64));
    }
    let ratios = [0, 1].map(|k| Ratios(checks.iter().filter_map(|c| c.ratios[k]).collect()));
    Ok(Checked {
        quality: Quality {
            solves: solves.len(),
            checks: checks.len(),
            residual_max: checks.iter().map(|c| c.residual).fold(0.0, f64::max),
            corrected_percent: ratios.each_ref().map(|r| r.percent(|r| r.ratio - 1.0)),
            error_percent: ratios.each_ref().map(Ratios::error_percent),
        },
        ratios,
    })
}

/// Checks solves in the order of time, on a copy of the tissue that begins uncut.
fn check(
    model: &Arc<Model>,
    part: &[&Solve],
    cuts: &[(i64, Operation)],
    done: &Sender<()>,
    stop: &AtomicBool,
) -> Result<Vec<Check>, ReferenceError> {
    let mut copy = Replica::new(Arc::clone(model), true);
    let mut cuts = cuts.iter().peekable();
    let mut checks = Vec::with_capacity(part.len());
    for solve in part {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        while let Some((_, cut)) = cuts.next_if(|(us, _)| *us <= solve.us) {
            copy.apply(cut)?;
        }
        let now = ClientTime::from_micros(solve.us);
        let [a, b] = solve.tools;
        let first = copy.haptic_step(now, Some(&a), &[b], Budget::new(ITERATIONS, TOLERANCE));
        let residual = copy.haptic_residual().unwrap_or(f64::INFINITY);
        // The shape is solved for both: the second call only asks what the other hand feels.
        let second = copy.haptic_step(now, Some(&b), &[a], Budget::new(0, f64::INFINITY));
        let ratio = |k: usize, model| {
            let (tracked, checked) = (pressed(&solve.models[k]), pressed(model));
            let ratio = checked / tracked;
            (tracked > FORCE_MIN_N && RATIOS.contains(&ratio)).then_some(Ratio {
                us: solve.us,
                ratio,
                force_n: tracked,
            })
        };
        checks.push(Check {
            residual,
            ratios: [ratio(0, &first), ratio(1, &second)],
        });
        // When nobody listens, the end is on its way.
        let _ = done.send(());
    }
    Ok(checks)
}

impl Ratios {
    /// The ratio at a moment: linear between checks, and before the first and after the last as there; 1 without any.
    pub(super) fn at(&self, us: i64) -> f64 {
        let next = self.0.partition_point(|r| r.us <= us);
        match (next.checked_sub(1).map(|k| self.0[k]), self.0.get(next)) {
            (Some(last), Some(next)) => between(&last, next, us),
            (Some(only), None) => only.ratio,
            (None, Some(only)) => only.ratio,
            (None, None) => 1.0,
        }
    }

    /// Root mean square of the force times `part`, percent of that of the force.
    fn percent(&self, part: impl Fn(&Ratio) -> f64) -> f64 {
        let (error, size) = self.0.iter().fold((0.0, 0.0), |(error, size), r| {
            let square = r.force_n * r.force_n;
            (error + square * part(r).powi(2), size + square)
        });
        if size > 0.0 {
            100.0 * (error / size).sqrt()
        } else {
            0.0
        }
    }

    /// How far ratios are from what their neighbours say, rms over those that have two.
    fn error_percent(&self) -> f64 {
        let mut inner = Vec::new();
        for w in self.0.windows(3) {
            let predicted = between(&w[0], &w[2], w[1].us);
            inner.push(Ratio {
                ratio: predicted - w[1].ratio,
                ..w[1]
            });
        }
        Self(inner).percent(|r| r.ratio)
    }
}

fn between(a: &Ratio, b: &Ratio, us: i64) -> f64 {
    let share = (us - a.us) as f64 / (b.us - a.us).max(1) as f64;
    a.ratio + share * (b.ratio - a.ratio)
}

#[cfg(test)]
mod tests {
    use super::{Ratio, Ratios};

    fn ratios(of: &[(i64, f64)]) -> Ratios {
        let ratio = |&(us, ratio)| Ratio {
            us,
            ratio,
            force_n: 2.0,
        };
        Ratios(of.iter().map(ratio).collect())
    }

    #[test]
    fn ratios_are_interpolated_and_constant_outside() {
        let r = ratios(&[(100, 1.0), (200, 0.9)]);
        for (us, expected) in [(0, 1.0), (100, 1.0), (150, 0.95), (200, 0.9), (900, 0.9)] {
            assert!((r.at(us) - expected).abs() < 1e-12, "{us}");
        }
        assert_eq!(ratios(&[]).at(7), 1.0);
    }

    #[test]
    fn the_error_estimate_is_zero_for_a_straight_course_and_the_jump_for_a_spike() {
        let straight = ratios(&[(0, 1.0), (10, 0.98), (30, 0.94), (40, 0.92)]);
        assert!(straight.error_percent() < 1e-9);
        let spike = ratios(&[(0, 1.0), (10, 0.95), (20, 1.0)]);
        assert!((spike.error_percent() - 5.0).abs() < 1e-9);
        assert_eq!(ratios(&[]).error_percent(), 0.0);
    }
}
