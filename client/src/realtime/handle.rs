//! The rest of the program's hold on the haptic thread.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

use hdrhistogram::Histogram;
use triple_buffer::Output;

use super::stats::LoopStats;
use super::thread::Control;
use super::trace::Trace;
use palpate_transport::threads::Scheduling;

/// The whole run.
pub struct LoopSummary {
    /// The figures at the end.
    pub stats: LoopStats,
    /// How the thread was scheduled.
    pub scheduling: Scheduling,
    /// How long after their deadlines ticks began, µs.
    pub lateness_us: Histogram<u32>,
    /// How long ticks took, µs.
    pub work_us: Histogram<u32>,
    /// The path and the force.
    pub trace: Trace,
    /// What a panic on the thread said; the force was taken away and the device closed. `None`
    /// is as it should be.
    pub panicked: Option<String>,
}

/// Steers the haptic thread. Dropping it stops the thread as [`stop`](Self::stop) does.
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

    /// How the thread is scheduled, with a sentence for the user where that is not as wanted.
    pub fn scheduling(&self) -> &Scheduling {
        &self.scheduling
    }

    /// The newest figures; the thread publishes them four times a second.
    pub fn stats(&mut self) -> LoopStats {
        *self.stats.read()
    }

    /// Whether the thread lives. It ends early only by a panic, and the summary then says so.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }

    /// The link to the session is lost (the force fades within 100 ms) or is back (the force
    /// returns over the soft start).
    pub fn set_link_lost(&self, lost: bool) {
        self.control.link_lost.store(lost, Ordering::Release);
    }

    /// Whether ticks go into the trace.
    pub fn set_recording(&self, on: bool) {
        self.control.recording.store(on, Ordering::Release);
    }

    /// Fades the force, closes the device and ends the thread; takes about 0.1 s.
    pub fn stop(mut self) -> LoopSummary {
        self.control.stop.store(true, Ordering::Release);
        let thread = self
            .thread
            .take()
            .expect("only stop and drop take it, and both are last");
        // `run` catches panics of loop and device; what is left is ours.
        thread.join().expect("the haptic thread catches its panics")
    }
}

impl Drop for HapticHandle {
    fn drop(&mut self) {
        self.control.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the haptic thread ended by a panic");
        }
    }
}
