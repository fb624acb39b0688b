//! The motion thread: what the hand did, to the session and to the replica, every 4 ms.
//!
//! It is a thread of its own because neither a long solve nor a busy network task may make the hand
//! look late to the others.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

use palpate_protocol::{LocalSample, Span};
use palpate_transport::ClientCommand;
use palpate_transport::threads::{self, ThreadClass};
use tokio::sync::mpsc;

use crate::convert::local_sample;
use crate::realtime::{Frame, monotonic_now, sleep_until};

/// From one handing over to the next: four samples of 1 kHz, which fill a datagram.
const PERIOD: Span = Span::from_millis(4);

/// Samples on their way to the replica: four seconds. While it is busy for longer, the newest are
/// lost to its own view of the hand (and counted); the others have them.
const OWN_SAMPLES_MAX: usize = 4096;

/// The thread, while it runs.
pub(crate) struct MotionThread {
    stop: Arc<AtomicBool>,
    dropped: Arc<AtomicU64>,
    thread: JoinHandle<()>,
}

impl MotionThread {
    /// Starts it; gives the samples for the replica.
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
                // After a pause the missed turns are one.
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

    /// Ends it; the samples that found no room.
    pub(crate) fn stop(self) -> u64 {
        self.stop.store(true, Ordering::Release);
        if self.thread.join().is_err() {
            tracing::error!("the motion thread ended by a panic");
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
