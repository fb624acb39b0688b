//! A histogram of equal steps.

use hdrhistogram::Histogram;

/// Number of steps; larger values count as the last one.
const STEPS: u64 = 40_000;

/// Values in steps of 1 / `PER_UNIT`, with their sum and maximum.
#[derive(Debug, Clone)]
pub(crate) struct StepHistogram<const PER_UNIT: u32> {
    steps: Histogram<u64>,
    sum: f64,
    pub(crate) max: f64,
}

impl<const PER_UNIT: u32> Default for StepHistogram<PER_UNIT> {
    fn default() -> Self {
        // Five digits resolve every step.
        let steps = Histogram::new_with_max(STEPS, 5).expect("the bounds are valid");
        let (sum, max) = (0.0, 0.0);
        Self { steps, sum, max }
    }
}

impl<const PER_UNIT: u32> StepHistogram<PER_UNIT> {
    const SIZE: f64 = 1.0 / PER_UNIT as f64;

    pub(crate) fn add(&mut self, value: f64) {
        let step = ((value / Self::SIZE) as u64).min(STEPS - 1);
        self.steps.saturating_record(step);
        self.sum += value;
        self.max = self.max.max(value);
    }

    pub(crate) fn join(mut self, other: &Self) -> Self {
        self.steps += &other.steps;
        self.sum += other.sum;
        self.max = self.max.max(other.max);
        self
    }

    /// 0 without values.
    pub(crate) fn mean(&self) -> f64 {
        self.sum / self.steps.len().max(1) as f64
    }

    /// Upper edge of the step that reaches the share `q`, at most the maximum; 0 without values.
    pub(crate) fn quantile(&self, q: f64) -> f64 {
        ((self.steps.value_at_quantile(q) + 1) as f64 * Self::SIZE).min(self.max)
    }
}
