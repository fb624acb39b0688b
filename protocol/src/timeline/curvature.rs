//! The share of Verlet's curvature that a stream can bear.
//!
//! Between samples x0 and x1 Verlet's rule adds a curvature c to the straight line l. Noise of the samples around makes c
//! worse than nothing for some devices. The share s with the least squared error is the regression
//!
//! ```text
//! x = l + s c        s = Σ (x - l)·c / Σ c·c        0 <= s <= 1
//! ```
//!
//! over samples x that are left out for the purpose, with exponential forgetting. It is Wiener's gain: the variance of
//! the true curvature divided by that of the measured one.

use crate::verlet::{Vec3, map2};
use crate::{ServerTime, Span};

/// Interval of regressions.
const INTERVAL: Span = Span::from_millis(10);

/// Time constant of the forgetting, seconds: that of the predictors' errors.
const MEMORY_S: f64 = 2.0;

/// Curvatures below 0.02 mm count as signal: rounding on the wire is half of that.
const SIGNAL_M: f64 = 2e-5;

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CurvatureShare {
    latest: Option<ServerTime>,
    /// Mean of (x - l)·c, m².
    covariance: f64,
    /// Mean of c·c, m².
    variance: f64,
}

impl CurvatureShare {
    /// Whether a regression is due at this time.
    pub(super) fn is_due(&self, now: ServerTime) -> bool {
        self.latest.is_none_or(|latest| now - latest >= INTERVAL)
    }

    /// Takes a sample, and where the straight line and the full curve meet its time.
    pub(super) fn learn(&mut self, now: ServerTime, sample: Vec3, line: Vec3, curve: Vec3) {
        let elapsed = self.latest.map_or(INTERVAL, |latest| now - latest);
        let share = 1.0 - (-elapsed.as_secs_f64() / MEMORY_S).exp();
        let curvature = map2(curve, line, |c, l| c - l);
        let dot = |a: Vec3, b: Vec3| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        let off = map2(sample, line, |x, l| x - l);
        self.covariance += share * (dot(off, curvature) - self.covariance);
        self.variance += share * (dot(curvature, curvature) - self.variance);
        self.latest = Some(now);
    }

    /// The straight line with the share of the curve's curvature.
    pub(super) fn blend(&self, line: Vec3, curve: Vec3) -> Vec3 {
        let signal = SIGNAL_M * SIGNAL_M;
        let share = ((self.covariance + signal) / (self.variance + signal)).clamp(0.0, 1.0);
        map2(line, curve, |l, c| l + share * (c - l))
    }
}
