//! The thread that reads a device, so that the force loop never waits for it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::JoinHandle;
use std::time::Duration;

use thiserror::Error;

use super::Controls;
use super::controls::Publisher;

/// Wait for a message between two checks of the cue and of the stop flag: half of the minimum time between two
/// changes of a cue.
const PATIENCE: Duration = Duration::from_millis(16);

/// Period of the search for an unplugged device.
pub const REOPEN_EVERY: Duration = Duration::from_millis(500);

/// Result of a wait for a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SourceEvent {
    /// No message in time.
    Quiet,
    /// The present controls.
    Controls(Controls),
    /// An invalid message.
    Garbled,
}

/// The device does not answer any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("the device does not answer any more")]
pub struct DeviceLost;

/// Source of deflections. It lives on its own thread and may wait there.
pub trait Source: Send {
    /// Waits at most `patience` for the next message.
    fn listen(&mut self, patience: Duration) -> Result<SourceEvent, DeviceLost>;

    /// Looks once, without waiting, for the lost device; returns whether it is back.
    fn reopen(&mut self) -> bool;

    /// Sets the strength of the cue, 0 to 1, until the next call, where the hardware supports it.
    fn hint(&mut self, _strength: f32) {}
}

/// The strength of a cue, 0 to 1, passed to the driver's thread.
#[derive(Debug, Clone, Default)]
pub(super) struct Hint(Arc<AtomicU32>);

impl Hint {
    pub(super) fn set(&self, strength: f32) {
        self.0.store(strength.to_bits(), Ordering::Relaxed);
    }

    fn get(&self) -> f32 {
        f32::from_bits(self.0.load(Ordering::Relaxed))
    }
}

/// The thread, while it runs.
#[derive(Debug)]
pub(super) struct Driver {
    /// Dropping it stops the thread.
    keep: Option<mpsc::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Driver {
    pub(super) fn spawn(
        source: Box<dyn Source>,
        publisher: Publisher,
        hint: Hint,
    ) -> std::io::Result<Self> {
        let (keep, kept) = mpsc::channel();
        let thread = std::thread::Builder::new()
            .name("device".to_owned())
            .spawn(move || run(source, publisher, &hint, &kept))?;
        Ok(Self {
            keep: Some(keep),
            thread: Some(thread),
        })
    }

    /// Ends the thread, which releases the device. A second call does nothing.
    pub(super) fn stop(&mut self) {
        self.keep = None;
        if let Some(thread) = self.thread.take() {
            // After a panic, the device already counts as unplugged.
            let _ = thread.join();
        }
    }
}

impl Drop for Driver {
    fn drop(&mut self) {
        self.stop();
    }
}

fn run(
    mut source: Box<dyn Source>,
    mut publisher: Publisher,
    hint: &Hint,
    keep: &mpsc::Receiver<()>,
) {
    let mut hinted = 0.0;
    let goes_on = |patience| keep.recv_timeout(patience) == Err(RecvTimeoutError::Timeout);
    while goes_on(Duration::ZERO) {
        match source.listen(PATIENCE) {
            Ok(SourceEvent::Quiet) => {}
            Ok(SourceEvent::Controls(controls)) if controls.is_finite() => {
                publisher.publish(controls);
            }
            Ok(SourceEvent::Controls(_) | SourceEvent::Garbled) => publisher.garbled(),
            Err(DeviceLost) => {
                publisher.present(false);
                loop {
                    if !goes_on(REOPEN_EVERY) {
                        return;
                    }
                    if source.reopen() {
                        break;
                    }
                }
                publisher.present(true);
                // The device has lost its earlier cue.
                hinted = 0.0;
            }
        }
        let strength = hint.get();
        if strength != hinted {
            source.hint(strength);
            hinted = strength;
        }
    }
    if hinted > 0.0 {
        source.hint(0.0);
    }
}
