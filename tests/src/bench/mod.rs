//! Benchmarks: solver cost and force error, force-loop tick, bandwidth and coding of a session, cost and
//! accuracy of the reference of a demo.
//!
//! They are not tests: a slow machine does not fail. Compare figures (two models, two commits) within one run
//! on one machine.

pub mod ablate;
pub mod bytes;
pub mod coding;
pub mod cuts;
pub mod haptic_tick;
pub mod press_cube;
pub mod press_scene;
mod quic;
pub mod reference;
pub mod wound;

/// Median of times in ms.
fn median(times: &[f64]) -> f64 {
    quantile(times, 0.5)
}

/// The quantile `q` of times, in their unit.
pub(crate) fn quantile(times: &[f64], q: f64) -> f64 {
    let mut sorted = times.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    let at = ((sorted.len() as f64 * q).ceil() as usize).clamp(1, last + 1) - 1;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// Runs a closure on this many threads.
///
/// # Errors
///
/// If the operating system cannot create the threads.
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
