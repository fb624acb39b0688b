//! The line of the offset over time, from answers that were each some time on their way.
//!
//! Two estimates, each the better one on other paths:
//! - the **strip** between the fastest packets of both ways. Where packets wait in a queue now and then, its ends are
//!   known after few of them, and what waits longer does not count.
//! - the **mean** of all offsets, a line of least squares. Where every packet takes a little more or less (a bell, and no
//!   edge), the fastest is an outlier and the mean of n of them is √n times surer than one.
//!
//! How wrong either may be shows in the answers themselves, and each counts by the inverse of its variance: for the
//! mean the scatter over n, for the strip the distances between the fastest packets. A queue on one way draws the
//! mean aside, but scatters it too, so that the strip counts there.
//!
//! Over a short history any scatter looks like drift. So the slope of the mean has a price: the ratio of the scatter to
//! what crystals drift as a rule is added to its normal equation. A burst delays several answers alike, which then count
//! as fewer. These weights are a reconstruction of our own.

use std::collections::VecDeque;

use super::{DRIFT_MAX, DRIFT_MIN};
use crate::ClientTime;

/// How far two crystals' rates are apart as a rule: an ordinary one is within some 30 to 50 ppm of its name. What history
/// is short says less of the drift than this does.
const DRIFT_USUAL: f64 = 40e-6;

/// So many of the fastest packets of a way tell how surely its very fastest is known.
const FASTEST: usize = 8;

#[derive(Debug, Clone, Copy)]
pub(super) struct Measurement {
    pub at: ClientTime,
    pub rtt_us: i64,
    /// t1 - t0: the offset and the way up.
    pub above_us: i64,
    /// t2 - t3: the offset less the way down.
    pub below_us: i64,
}

impl Measurement {
    /// θ, wrong by at most half the round trip.
    pub(super) fn offset_us(&self) -> f64 {
        self.above_us.midpoint(self.below_us) as f64
    }
}

/// The widest strip between the two ways: at `origin`, on the slope.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strip {
    pub middle_us: f64,
    width_us: f64,
    pub slope: f64,
}

/// The line of least squares through the offsets of all answers: at `origin`, on the slope.
#[derive(Debug, Clone, Copy)]
struct Mean {
    middle_us: f64,
    /// Of the middle of the history.
    variance_us2: f64,
    slope: f64,
}

/// The answers that an estimate rests on, oldest first.
pub(super) struct Answers<'a> {
    pub answers: &'a VecDeque<Measurement>,
}

impl Answers<'_> {
    /// The strip of one slope, at `origin`.
    fn strip(&self, origin: ClientTime, slope: f64) -> Strip {
        let (mut above_us, mut below_us) = (f64::INFINITY, f64::NEG_INFINITY);
        // Relative to one of them, so that hours of offset lose no digits.
        let reference = self.answers.back().map_or(0, |m| m.above_us);
        for m in self.answers {
            let leaned = slope * (m.at - origin).as_micros() as f64;
            above_us = above_us.min(m.above_us.saturating_sub(reference) as f64 - leaned);
            below_us = below_us.max(m.below_us.saturating_sub(reference) as f64 - leaned);
        }
        Strip {
            middle_us: reference as f64 + 0.5 * (above_us + below_us),
            width_us: above_us - below_us,
            slope,
        }
    }

    /// The offset line by what is surer: the widest strip, or the mean of all answers.
    pub(super) fn line(&self, origin: ClientTime) -> Strip {
        let mean = self.mean_line(origin);
        let unsure_us = self.unsure_of_fastest(origin, mean.slope);
        let strip = self.widest_strip(origin);
        let by_strip = 0.5 * unsure_us * unsure_us;
        let by_mean = mean.variance_us2;
        // Of two that know nothing against each other the strip is believed: it can not be drawn aside.
        let share = if by_strip > 0.0 {
            by_strip / (by_strip + by_mean)
        } else {
            0.0
        };
        Strip {
            middle_us: strip.middle_us + share * (mean.middle_us - strip.middle_us),
            slope: strip.slope + share * (mean.slope - strip.slope),
            ..strip
        }
    }

    /// The line of least squares through all offsets, its slope held by [`DRIFT_USUAL`].
    fn mean_line(&self, origin: ClientTime) -> Mean {
        let reference = self.answers.back().map_or(0, |m| m.above_us);
        let points: Vec<(f64, f64)> = (self.answers.iter())
            .map(|m| {
                let above_us = m.above_us.saturating_sub(reference);
                let below_us = m.below_us.saturating_sub(reference);
                let at_us = (m.at - origin).as_micros() as f64;
                (at_us, 0.5 * (above_us as f64 + below_us as f64))
            })
            .collect();
        let n = points.len().max(1) as f64;
        let middle = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
        let (t0, x0) = (middle(|p| p.0), middle(|p| p.1));
        let sum = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
            points.iter().map(|p| of(p.0 - t0, p.1 - x0)).sum()
        };
        let (tt, tx) = (sum(&|t, _| t * t), sum(&|t, x| t * x));
        let free = if tt > 0.0 { tx / tt } else { 0.0 };
        let scatter_us2 = sum(&|t, x| (x - free * t).powi(2)) / (n - 2.0).max(1.0);
        let held = scatter_us2 / DRIFT_USUAL.powi(2);
        let slope = if tt + held > 0.0 {
            tx / (tt + held)
        } else {
            0.0
        };
        let slope = slope.clamp(-DRIFT_MAX, DRIFT_MAX);
        // A burst delays several answers alike: they tell as much as one, and n counts for less.
        let off = |p: &(f64, f64)| p.1 - x0 - free * (p.0 - t0);
        let squares: f64 = points.iter().map(|p| off(p).powi(2)).sum();
        let alike: f64 = points.windows(2).map(|w| off(&w[0]) * off(&w[1])).sum();
        let likeness = if squares > 0.0 { alike / squares } else { 0.0 };
        let likeness = likeness.clamp(0.0, 0.99);
        Mean {
            middle_us: reference as f64 + x0 - slope * t0,
            variance_us2: scatter_us2 / n * (1.0 + likeness) / (1.0 - likeness),
            slope,
        }
    }

    /// How far the fastest packet of a way may be from the fastest that there could be: the mean distance between the
    /// [`FASTEST`] (of an exponential tail, which every smooth one is near its end, that is its standard deviation).
    fn unsure_of_fastest(&self, origin: ClientTime, slope: f64) -> f64 {
        let between = |of: &dyn Fn(&Measurement) -> i64, slope: f64| -> f64 {
            let reference = self.answers.back().map_or(0, of);
            let mut beyond: Vec<f64> = (self.answers.iter())
                .map(|m| {
                    let leaned = slope * (m.at - origin).as_micros() as f64;
                    of(m).saturating_sub(reference) as f64 - leaned
                })
                .collect();
            beyond.sort_unstable_by(f64::total_cmp);
            let last = FASTEST.min(beyond.len() / 2);
            match (beyond.first(), beyond.get(last)) {
                (Some(first), Some(next)) if last > 0 => (next - first) / last as f64,
                _ => 0.0,
            }
        };
        let (up, down) = (
            between(&|m| m.above_us, slope),
            between(&|m| m.below_us.saturating_neg(), -slope),
        );
        (0.5 * (up * up + down * down)).sqrt()
    }

    /// The widest strip. Its width is concave in the slope (a least of straight lines less a greatest), so that thirds
    /// find it. Its slope has no price: a burst spreads the fastest, and the price of that kept true drifts out.
    fn widest_strip(&self, origin: ClientTime) -> Strip {
        const THIRDS: u32 = 18;
        let history = self.answers.back().zip(self.answers.front());
        if history.is_none_or(|(last, first)| last.at - first.at < DRIFT_MIN) {
            return self.strip(origin, 0.0);
        }
        let (mut low, mut high) = (-DRIFT_MAX, DRIFT_MAX);
        for _ in 0..THIRDS {
            let third = (high - low) / 3.0;
            let (a, b) = (low + third, high - third);
            if self.strip(origin, a).width_us < self.strip(origin, b).width_us {
                low = a;
            } else {
                high = b;
            }
        }
        self.strip(origin, 0.5 * (low + high))
    }
}
