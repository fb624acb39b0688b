//! Kalman filters of several cut-offs, and the weights of all predictors by their measured errors.
//!
//! Neither the noise of a device nor the agility of its hand is known. Filters for several ratios of the
//! two run side by side (a multiple-model estimator: Magill 1965; Bar-Shalom, Li and Kirubarajan 2001,
//! section 11.6), beside the predictors that need no state. For each of several horizons, predictions are
//! compared with the sample that arrives (innovation), and the mean squared error e of each predictor is
//! kept with exponential forgetting. The prediction is the mean of all with the weights
//!
//! ```text
//! w = e^-n                n = 8
//! ```
//!
//! the likelihood of 2n/3 independent innovations of unknown variance. It is nearly a choice of the best,
//! and blends predictors that are equally good. Position and rotation have weights of their own.

use super::kalman::{Components, Kalman};
use crate::{ServerTime, Span};

/// Cut-offs of the filters, rad/s: octaves from slow hands before a noisy tracker to a quiet haptic device.
pub(super) const CUTOFFS: [f64; 4] = [30.0, 60.0, 120.0, 240.0];

/// Hold, linear and windowed Verlet, then the filters.
pub(super) const PREDICTORS: usize = 3 + CUTOFFS.len();

/// Horizons of measured errors: octaves, the last up to more than the gap limit.
const HORIZONS: [Span; 6] = [
    Span::from_micros(2500),
    Span::from_millis(5),
    Span::from_millis(10),
    Span::from_millis(20),
    Span::from_millis(40),
    Span::from_millis(80),
];

/// Time constant of the forgetting, seconds. 1 to 6 s are within 1 %.
const MEMORY_S: f64 = 2.0;

/// Innovations before a horizon has weights of its own.
const INNOVATIONS_MIN: u32 = 3;

/// n of the weights. At 2 poor predictors disturb; the best alone (n = ∞) is up to 6 % worse where two are
/// equally good.
const LIKELIHOOD: i32 = 8;

/// Added to squared errors: 0.1 µm or µrad, below any quantisation.
const FLOOR: f64 = 1e-14;

/// Squared errors or weights of position and rotation, by predictor.
pub(super) type Scores = [[f64; 2]; PREDICTORS];

pub(super) type Filters = [Kalman; CUTOFFS.len()];

/// A prediction over one horizon.
#[derive(Debug, Clone, Copy, Default)]
struct Trial {
    /// Begin of the current prediction, and the filters at that time.
    began: Option<(ServerTime, Filters)>,
    innovations: u32,
    errors: Scores,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Bank {
    pub(super) filters: Filters,
    /// First predictor in use: 0 for all, 3 for the filters alone.
    pub(super) first: usize,
    trials: [Trial; HORIZONS.len()],
}

impl Bank {
    pub(super) fn new(first: usize, sample: &Components) -> Self {
        Self {
            filters: CUTOFFS.map(|cutoff| Kalman::new(cutoff, sample)),
            first,
            trials: [Trial::default(); HORIZONS.len()],
        }
    }

    /// Restarts the filters after a pause. The errors are kept, because the device is the same.
    pub(super) fn restart(&mut self, sample: &Components) {
        self.filters = CUTOFFS.map(|cutoff| Kalman::new(cutoff, sample));
        for trial in &mut self.trials {
            trial.began = None;
        }
    }

    /// Takes a sample that is newer than all before. `errors` returns the squared errors at this sample of
    /// the predictions from an earlier time with the filters of that time.
    pub(super) fn update(
        &mut self,
        time: ServerTime,
        elapsed: Span,
        sample: &Components,
        errors: impl Fn(ServerTime, &Filters) -> Scores,
    ) {
        for filter in &mut self.filters {
            filter.update(elapsed.as_secs_f64(), sample);
        }
        for (trial, horizon) in self.trials.iter_mut().zip(HORIZONS) {
            let Some((began, filters)) = trial.began else {
                // Not at the sample that ended the last prediction, so that predictions do not keep step
                // with a device that repeats its samples.
                trial.began = Some((time, self.filters));
                continue;
            };
            let span = time - began;
            if span < horizon {
                continue;
            }
            trial.began = None;
            // Longer spans count for the next horizon.
            if span > horizon + horizon {
                continue;
            }
            let share = 1.0 - (-span.as_secs_f64() / MEMORY_S).exp();
            let found = errors(began, &filters);
            for (kept, found) in trial
                .errors
                .iter_mut()
                .flatten()
                .zip(found.iter().flatten())
            {
                *kept += share * (found - *kept);
            }
            trial.innovations = trial.innovations.saturating_add(1);
        }
    }

    /// Weights for a prediction over `span`: those of its two horizons, interpolated. Their sums are 1.
    pub(super) fn weights(&self, span: Span) -> Scores {
        let above = HORIZONS.partition_point(|h| *h < span);
        let last = HORIZONS.len() - 1;
        let (low, high) = (above.saturating_sub(1), above.min(last));
        let (from, to) = (HORIZONS[low], HORIZONS[high]);
        let u = if low == high {
            0.0
        } else {
            (span - from).as_secs_f64() / (to - from).as_secs_f64()
        };
        let (a, b) = (self.weights_at(low), self.weights_at(high));
        std::array::from_fn(|c| std::array::from_fn(|k| (1.0 - u) * a[c][k] + u * b[c][k]))
    }

    /// Weights at a horizon. One without innovations has those of the next longer, because the period of
    /// samples is longer, or else of the next shorter.
    fn weights_at(&self, horizon: usize) -> Scores {
        let known = |k: &usize| self.trials[*k].innovations >= INNOVATIONS_MIN;
        let longer = (horizon..HORIZONS.len()).find(known);
        let Some(k) = longer.or_else(|| (0..horizon).rev().find(known)) else {
            // Nothing measured: windowed Verlet, or the third filter.
            let mut prior = [[0.0; 2]; PREDICTORS];
            prior[self.first + 2] = [1.0; 2];
            return prior;
        };
        let errors = &self.trials[k].errors;
        let mut weights = [[0.0; 2]; PREDICTORS];
        for part in 0..2 {
            let used = self.first..PREDICTORS;
            let least = used
                .clone()
                .map(|c| errors[c][part])
                .fold(f64::MAX, f64::min);
            let weight = |c: usize| ((least + FLOOR) / (errors[c][part] + FLOOR)).powi(LIKELIHOOD);
            let sum: f64 = used.clone().map(weight).sum();
            for c in used {
                weights[c][part] = weight(c) / sum;
            }
        }
        weights
    }
}
