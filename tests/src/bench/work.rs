//! Processor time of repeated work.

use serde::Serialize;

use super::quantile;

/// Processor time per work item, ms.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Work {
    pub count: usize,
    pub mean_ms: f64,
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub max_ms: f64,
}

impl Work {
    pub fn of(times: &[f64]) -> Self {
        Self {
            count: times.len(),
            mean_ms: times.iter().sum::<f64>() / times.len().max(1) as f64,
            p50_ms: quantile(times, 0.5),
            p99_ms: quantile(times, 0.99),
            max_ms: quantile(times, 1.0),
        }
    }
}
