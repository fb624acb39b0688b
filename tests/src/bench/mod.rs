//! Benchmarks: solver cost and force error, force-loop tick, bandwidth and coding of a session.
//!
//! They are not tests: a slow machine does not fail. Compare figures (two models, two commits) within one run
//! on one machine.

pub mod ablate;
pub mod blade_sample;
pub mod bytes;
pub mod coding;
pub mod cuts;
pub mod haptic_tick;
pub mod late_join;
pub mod press_cube;
pub mod press_scene;
mod quic;
pub mod view_cost;
pub mod work;
pub mod wound;

use std::fmt::Display;

use clap::Args;
use serde::Serialize;

/// Receives the stage of a measurement.
pub type OnStage<'a> = dyn FnMut(&str) + Send + 'a;

pub trait Benchmark: Args {
    type Report: Serialize + Display;

    /// Fails if an option is out of range, or the model or the machine does not allow the measurement.
    fn measure(&self, on_stage: &mut OnStage<'_>) -> Result<Self::Report, String>;
}

fn median(times: &[f64]) -> f64 {
    quantile(times, 0.5)
}

/// The quantile `q` of times, in their unit; NaN without times.
pub(crate) fn quantile(times: &[f64], q: f64) -> f64 {
    let mut sorted = times.to_vec();
    sorted.sort_by(f64::total_cmp);
    quantile_of_sorted(&sorted, q).unwrap_or(f64::NAN)
}

/// The smallest value that is not below a share `q` of the sorted values.
pub(crate) fn quantile_of_sorted<T: Copy>(sorted: &[T], q: f64) -> Option<T> {
    let rank = (sorted.len() as f64 * q).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

pub fn on_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> Result<T, String> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| format!("cannot start {threads} threads: {e}"))?;
    Ok(pool.install(run))
}

#[cfg(test)]
mod tests {
    use super::{median, quantile};

    #[test]
    fn quantiles_are_values_of_the_sample() {
        let times = [3.0, 1.0, 2.0];
        assert_eq!(median(&times), 2.0);
        assert_eq!(quantile(&times, 0.99), 3.0);
        assert!(median(&[]).is_nan());
    }
}
