//! Chebyshev iterations, and how many of them a V-cycle makes.
//!
//! Their polynomial needs no order of points, so smoothing runs over whole sets in vectors.

/// Lowest eigenvalue that smoothing looks after, in parts of the bound on all.
pub(super) const LOW: f32 = 0.15;
/// The same on the coarsest level.
pub(super) const LOW_COARSEST: f32 = 0.02;
/// How much a V-cycle does.
#[derive(Clone, Copy)]
pub(super) struct Effort {
    /// Smoothing steps on each level before the correction of the coarser one, and after it.
    pub(super) before: usize,
    pub(super) after: usize,
    /// Steps on the coarsest level, which stand for a solve.
    pub(super) coarsest: usize,
    /// Load in thresholds on a point outside of the set from which on it is to be let in.
    pub(super) loaded: f32,
}

/// The factors of a Chebyshev iteration on [low, 1] times the bound.
pub(super) struct Chebyshev {
    theta: f32,
    delta: f32,
    rho: f32,
}

impl Chebyshev {
    pub(super) fn new(low: f32) -> Self {
        let (theta, delta) = (0.5 * (1.0 + low), 0.5 * (1.0 - low));
        Self {
            theta,
            delta,
            rho: 0.0,
        }
    }

    /// Factors of the last step and of the scaled residual.
    pub(super) fn next(&mut self) -> (f32, f32) {
        if self.rho == 0.0 {
            self.rho = self.delta / self.theta;
            return (0.0, 1.0 / self.theta);
        }
        let rho = 1.0 / (2.0 * self.theta / self.delta - self.rho);
        let factors = (rho * self.rho, 2.0 * rho / self.delta);
        self.rho = rho;
        factors
    }
}
