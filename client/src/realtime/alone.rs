//! Solvers that stay on their own thread.

use rayon::{ThreadPool, ThreadPoolBuilder};

/// Keeps parallel loops of the calling thread on that thread while the returned pool lives. A solver with real-time
/// priority must not wait for threads without, and its budget must count all of its work. `None` where the thread is
/// a pool's already.
pub(crate) fn compute_alone() -> Option<ThreadPool> {
    let pool = ThreadPoolBuilder::new().num_threads(1).use_current_thread();
    pool.build().ok()
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::compute_alone;

    #[test]
    fn parallel_loops_stay_on_the_calling_thread() {
        std::thread::spawn(|| {
            let pool = compute_alone();
            assert!(pool.is_some());
            let me = std::thread::current().id();
            let all_mine = (0..1000)
                .into_par_iter()
                .all(|_| std::thread::current().id() == me);
            assert!(all_mine);
            assert_eq!(rayon::current_num_threads(), 1);
        })
        .join()
        .unwrap();
    }
}
