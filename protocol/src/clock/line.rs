//! The line of the clock offset over time, fitted to probe answers with unknown one-way delays.
//!
//! Two estimates are combined, because each is better on other paths:
//! - The feasible **band** lies between the fastest packets of the uplink and of the downlink. Under
//!   queueing a few fast packets determine it, and slower packets do not count.
//! - The **mean** is a least-squares line through all offsets. Under jitter without a sharp minimum (a
//!   normal distribution) the fastest packet is an outlier, and the mean of n packets is √n times more
//!   precise than one.
//!
//! Each estimate is weighted by its inverse variance. The variance of the mean is the scatter over n;
//! that of the band follows from the distances between the fastest packets. A queue on one direction
//! biases the mean. The bias is estimated from the deviations of both directions and added to the variance,
//! so that the band dominates.
//!
//! Over a short history any scatter looks like drift. The slope of the mean is therefore regularised:
//! the ratio of the scatter to the usual crystal drift is added to its normal equation. A burst delays
//! several answers alike, which then count as fewer. These weights are our own.

use std::collections::VecDeque;

use super::{DRIFT_MAX, DRIFT_MIN};
use crate::ClientTime;

/// The usual rate difference of two crystals: an ordinary one is within 30 to 50 ppm of its nominal
/// rate. A short history knows less about the drift than this prior.
const DRIFT_USUAL: f64 = 40e-6;

/// The number of fastest packets per direction that determine the precision of the fastest one.
const FASTEST: usize = 8;

#[derive(Debug, Clone, Copy)]
pub(super) struct Measurement {
    pub at: ClientTime,
    pub rtt_us: i64,
    /// t1 - t0: the offset plus the uplink delay.
    pub above_us: i64,
    /// t2 - t3: the offset minus the downlink delay.
    pub below_us: i64,
}

impl Measurement {
    /// θ, wrong by at most half the round trip.
    pub(super) fn offset_us(&self) -> f64 {
        self.above_us.midpoint(self.below_us) as f64
    }
}

/// The widest feasible band between the two directions: at `origin`, with its slope.
#[derive(Debug, Clone, Copy)]
pub(super) struct Band {
    pub middle_us: f64,
    width_us: f64,
    pub slope: f64,
}

/// The least-squares line through the offsets of all answers: at `origin`, with its slope.
#[derive(Debug, Clone, Copy)]
struct Mean {
    middle_us: f64,
    /// The variance at the middle of the history.
    variance_us2: f64,
    slope: f64,
}

/// The answers that an estimate uses, oldest first.
pub(super) struct Answers<'a> {
    pub answers: &'a VecDeque<Measurement>,
}

impl Answers<'_> {
    /// The band of one slope, at `origin`.
    fn band(&self, origin: ClientTime, slope: f64) -> Band {
        let (mut above_us, mut below_us) = (f64::INFINITY, f64::NEG_INFINITY);
        // Offsets are relative to one answer, so that hours of offset lose no digits.
        let reference = self.answers.back().map_or(0, |m| m.above_us);
        for m in self.answers {
            let leaned = slope * (m.at - origin).as_micros() as f64;
            above_us = above_us.min(m.above_us.saturating_sub(reference) as f64 - leaned);
            below_us = below_us.max(m.below_us.saturating_sub(reference) as f64 - leaned);
        }
        Band {
            middle_us: reference as f64 + 0.5 * (above_us + below_us),
            width_us: above_us - below_us,
            slope,
        }
    }

    /// The offset line: the band and the mean of all answers, weighted by precision.
    pub(super) fn line(&self, origin: ClientTime) -> Band {
        let mean = self.mean_line(origin);
        let uncertainty_us = self.fastest_uncertainty(origin, mean.slope);
        let band = self.widest_band(origin);
        let band_variance = 0.5 * uncertainty_us * uncertainty_us;
        let mean_variance = mean.variance_us2;
        // With a band variance of zero the band counts alone: a queue can not bias it.
        let share = if band_variance > 0.0 {
            band_variance / (band_variance + mean_variance)
        } else {
            0.0
        };
        Band {
            middle_us: band.middle_us + share * (mean.middle_us - band.middle_us),
            slope: band.slope + share * (mean.slope - band.slope),
            ..band
        }
    }

    /// The least-squares line through all offsets, its slope regularised by [`DRIFT_USUAL`].
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
        // A burst delays several answers alike, so that the effective n is smaller.
        let off = |p: &(f64, f64)| p.1 - x0 - free * (p.0 - t0);
        let squares: f64 = points.iter().map(|p| off(p).powi(2)).sum();
        let alike: f64 = points.windows(2).map(|w| off(&w[0]) * off(&w[1])).sum();
        let likeness = if squares > 0.0 { alike / squares } else { 0.0 };
        let likeness = likeness.clamp(0.0, 0.99);
        let variance_us2 = scatter_us2 / n * (1.0 + likeness) / (1.0 - likeness);
        // Half the difference of two deviations has half the variance of the mean; two standard errors are noise.
        let bias_us2 = self.asymmetry_us(origin, slope).powi(2) - 2.0 * variance_us2;
        Mean {
            middle_us: reference as f64 + x0 - slope * t0,
            variance_us2: variance_us2 + bias_us2.max(0.0),
            slope,
        }
    }

    /// The bias of the mean by unequal queues, estimated: half the difference between the standard deviations of the
    /// directions. The mean delay above the minimum is the standard deviation for an exponential tail.
    fn asymmetry_us(&self, origin: ClientTime, slope: f64) -> f64 {
        let deviation_us = |of: &dyn Fn(&Measurement) -> i64| {
            let reference = self.answers.back().map_or(0, of);
            let level_us = |m: &Measurement| {
                let leaned = slope * (m.at - origin).as_micros() as f64;
                of(m).saturating_sub(reference) as f64 - leaned
            };
            let n = self.answers.len().max(1) as f64;
            let mean_us = self.answers.iter().map(level_us).sum::<f64>() / n;
            let squares = (self.answers.iter()).map(|m| (level_us(m) - mean_us).powi(2));
            (squares.sum::<f64>() / n).sqrt()
        };
        0.5 * (deviation_us(&|m| m.above_us) - deviation_us(&|m| m.below_us))
    }

    /// The distance of the fastest packet of a direction from the minimum delay: the mean distance
    /// between the [`FASTEST`]. For an exponential tail, which every smooth tail resembles near its end,
    /// this is the standard deviation.
    fn fastest_uncertainty(&self, origin: ClientTime, slope: f64) -> f64 {
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

    /// The widest band. Its width is concave in the slope (a minimum of straight lines less a maximum),
    /// so that ternary search finds it. The slope has no prior: under bursts a prior suppressed real
    /// drift.
    fn widest_band(&self, origin: ClientTime) -> Band {
        const THIRDS: u32 = 18;
        let history = self.answers.back().zip(self.answers.front());
        if history.is_none_or(|(last, first)| last.at - first.at < DRIFT_MIN) {
            return self.band(origin, 0.0);
        }
        let (mut low, mut high) = (-DRIFT_MAX, DRIFT_MAX);
        for _ in 0..THIRDS {
            let third = (high - low) / 3.0;
            let (a, b) = (low + third, high - third);
            if self.band(origin, a).width_us < self.band(origin, b).width_us {
                low = a;
            } else {
                high = b;
            }
        }
        self.band(origin, 0.5 * (low + high))
    }
}
