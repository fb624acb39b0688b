//! Single-threaded solvers.

use rayon::{ThreadPool, ThreadPoolBuilder};

/// Keeps parallel loops of the calling thread on that thread while the returned pool lives. A real-time solver must
/// not wait for ordinary threads, and its CPU budget must cover all of its work. `None` if the thread already belongs
/// to a pool.
pub(crate) fn single_thread_pool() -> Option<ThreadPool> {
    let pool = ThreadPoolBuilder::new().num_threads(1).use_current_thread();
    pool.build().ok()
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::single_thread_pool;

    #[test]
    fn parallel_loops_run_on_calling_thread() {
        std::thread::spawn(|| {
            let pool = single_thread_pool();
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
