//! Benches: of the equilibrium, what it costs and how far it is from the converged answer; of the force loop, what a
//! tick costs; of a session, what it takes of a network, and what a pose and a node take; of a demo's reference, what
//! it takes and how exact it is.
//!
//! They are no tests: nothing here fails because a machine is slow. Figures that are to be compared
//! (two models, two commits) belong into one run on one machine.

pub mod bytes;
pub mod coding;
pub mod cuts;
pub mod haptic_tick;
pub mod press_cube;
pub mod press_scene;
mod quic;
pub mod reference;
pub mod wound;

/// Middle of some times in ms.
fn median(times: &[f64]) -> f64 {
    quantile(times, 0.5)
}

/// The value that the share `q` of some times does not exceed, in their unit.
pub(crate) fn quantile(times: &[f64], q: f64) -> f64 {
    let mut sorted = times.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    let at = ((sorted.len() as f64 * q).ceil() as usize).clamp(1, last + 1) - 1;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// Runs on this many threads.
///
/// # Errors
///
/// When the system has no threads to give.
pub fn on_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> Result<T, String> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| format!("no {threads} threads: {e}"))?;
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
