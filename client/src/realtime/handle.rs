//! Handle of the haptic thread for the rest of the program.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

use triple_buffer::Output;

use super::haptic_thread::Control;
use super::stats::LoopStats;
use super::trace::Trace;
use palpate_transport::threads::Scheduling;

/// Summary of the whole run.
pub struct LoopSummary {
    /// Final statistics.
    pub stats: LoopStats,
    /// How the thread was scheduled.
    pub scheduling: Scheduling,
    /// Recorded poses and forces.
    pub trace: Trace,
    /// Message of a panic on the thread, after which the force was set to zero and the device closed. `None` if the
    /// thread ended normally.
    pub panicked: Option<String>,
}

/// Controls the haptic thread. Dropping it stops the thread like [`stop`](Self::stop).
pub struct HapticHandle {
    control: Arc<Control>,
    stats: Output<LoopStats>,
    thread: Option<JoinHandle<LoopSummary>>,
    scheduling: Scheduling,
}

impl HapticHandle {
    pub(super) fn new(
        control: Arc<Control>,
        stats: Output<LoopStats>,
        thread: JoinHandle<LoopSummary>,
        scheduling: Scheduling,
    ) -> Self {
        Self {
            control,
            stats,
            thread: Some(thread),
            scheduling,
        }
    }

    /// Scheduling of the thread, with an explanation if it is not as requested.
    pub fn scheduling(&self) -> &Scheduling {
        &self.scheduling
    }

    /// The newest statistics; the thread publishes them four times a second.
    pub fn stats(&mut self) -> LoopStats {
        *self.stats.read()
    }

    /// Whether the thread runs. It ends early only by a panic, which the summary reports.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }

    /// Reports that the link to the session is lost (the force fades within 100 ms) or back (the force returns by the
    /// soft start).
    pub fn set_link_lost(&self, lost: bool) {
        self.control.link_lost.store(lost, Ordering::Release);
    }

    /// Fades the force, closes the device and ends the thread; takes about 0.1 s.
    pub fn stop(mut self) -> LoopSummary {
        self.control.stop.store(true, Ordering::Release);
        let thread = self
            .thread
            .take()
            .expect("only stop and drop take it, and both are last");
        // `run` catches panics of loop and device.
        thread.join().expect("the haptic thread catches its panics")
    }
}

impl Drop for HapticHandle {
    fn drop(&mut self) {
        self.control.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the haptic thread panicked");
        }
    }
}
