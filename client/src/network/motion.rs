//! The motion thread: sends the hand's samples to session and replica every 4 ms.
//!
//! A separate thread keeps samples on time despite long solves and a busy network task.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

use palpate_protocol::{LocalSample, Span};
use palpate_transport::ClientCommand;
use palpate_transport::threads::{self, ThreadClass};
use tokio::sync::mpsc;

use crate::realtime::{Frame, local_sample, monotonic_now, sleep_until};

/// Transfer period: four samples of 1 kHz, which fill a datagram.
const PERIOD: Span = Span::from_millis(4);

/// Samples queued for the replica: four seconds. If it stalls longer, the newest are dropped and counted; the other
/// participants still receive them.
const OWN_SAMPLES_MAX: usize = 4096;

/// The running thread.
pub(crate) struct MotionThread {
    stop: Arc<AtomicBool>,
    dropped: Arc<AtomicU64>,
    thread: JoinHandle<()>,
}

impl MotionThread {
    /// Starts the thread and returns the samples for the replica.
    pub(crate) fn spawn(
        frames: rtrb::Consumer<Frame>,
        commands: mpsc::Sender<ClientCommand>,
    ) -> std::io::Result<(Self, rtrb::Consumer<LocalSample>)> {
        let (own_in, own_out) = rtrb::RingBuffer::new(OWN_SAMPLES_MAX);
        let stop = Arc::new(AtomicBool::new(false));
        let dropped = Arc::new(AtomicU64::new(0));
        let mut pump = Pump {
            frames,
            commands,
            own: own_in,
            dropped: Arc::clone(&dropped),
        };
        let stopped = Arc::clone(&stop);
        let thread = threads::spawn(ThreadClass::Network, "motion", move || {
            let mut deadline = monotonic_now();
            while !stopped.load(Ordering::Acquire) {
                pump.turn();
                // Missed periods are skipped.
                deadline = (deadline + PERIOD).max(monotonic_now());
                sleep_until(deadline);
            }
        })?;
        let running = Self {
            stop,
            dropped,
            thread,
        };
        Ok((running, own_out))
    }

    /// Stops the thread and returns the number of dropped samples.
    pub(crate) fn stop(self) -> u64 {
        self.stop.store(true, Ordering::Release);
        if self.thread.join().is_err() {
            tracing::error!("the motion thread panicked");
        }
        self.dropped.load(Ordering::Relaxed)
    }
}

struct Pump {
    frames: rtrb::Consumer<Frame>,
    commands: mpsc::Sender<ClientCommand>,
    own: rtrb::Producer<LocalSample>,
    dropped: Arc<AtomicU64>,
}

impl Pump {
    fn turn(&mut self) {
        let mut batch = Vec::with_capacity(self.frames.slots());
        while let Ok(frame) = self.frames.pop() {
            let sample = local_sample(&frame);
            if self.own.push(sample).is_err() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
            batch.push(sample);
        }
        let count = batch.len() as u64;
        if count > 0
            && self
                .commands
                .try_send(ClientCommand::Motion(batch))
                .is_err()
        {
            self.dropped.fetch_add(count, Ordering::Relaxed);
        }
    }
}
