//! The thread that listens to a device, so that the force loop never waits for one.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::JoinHandle;
use std::time::Duration;

use thiserror::Error;

use super::Controls;
use super::controls::Teller;

/// How long the thread listens before it looks whether a cue changed, or the device is closed: half of the shortest
/// time between two changes of a cue.
const PATIENCE: Duration = Duration::from_millis(16);

/// How often an unplugged device is looked for.
pub const REOPEN_EVERY: Duration = Duration::from_millis(500);

/// What a device had to say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum News {
    /// Nothing, all the time that was waited.
    Quiet,
    /// What the hand does now.
    Controls(Controls),
    /// Something that makes no sense.
    Garbled,
}

/// The device does not answer any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("the device does not answer any more")]
pub struct Gone;

/// Where deflections come from. It lives on a thread of its own and may wait there.
pub trait Source: Send {
    /// Waits at most `patience` for what the hand does.
    fn listen(&mut self, patience: Duration) -> Result<News, Gone>;

    /// Looks once, without waiting, for the device that was gone; whether it is back.
    fn reopen(&mut self) -> bool;

    /// Gives the hand a hint of this strength, 0 to 1, until the next call, where the hardware can.
    fn hint(&mut self, _strength: f32) {}
}

/// The strength of a hint, 0 to 1, on its way to the driver's thread.
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
    /// Its end is the sign to stop.
    keep: Option<mpsc::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Driver {
    pub(super) fn spawn(
        source: Box<dyn Source>,
        teller: Teller,
        hint: Hint,
    ) -> std::io::Result<Self> {
        let (keep, kept) = mpsc::channel();
        let thread = std::thread::Builder::new()
            .name("device".to_owned())
            .spawn(move || run(source, teller, &hint, &kept))?;
        Ok(Self {
            keep: Some(keep),
            thread: Some(thread),
        })
    }

    /// Ends the thread, which lets go of the device. A second call does nothing.
    pub(super) fn stop(&mut self) {
        self.keep = None;
        if let Some(thread) = self.thread.take() {
            // If it panicked, the device has been called unplugged already.
            let _ = thread.join();
        }
    }
}

impl Drop for Driver {
    fn drop(&mut self) {
        self.stop();
    }
}

fn run(mut source: Box<dyn Source>, mut teller: Teller, hint: &Hint, keep: &mpsc::Receiver<()>) {
    let mut hinted = 0.0;
    let goes_on = |patience| keep.recv_timeout(patience) == Err(RecvTimeoutError::Timeout);
    while goes_on(Duration::ZERO) {
        match source.listen(PATIENCE) {
            Ok(News::Quiet) => {}
            Ok(News::Controls(controls)) if controls.is_finite() => teller.tell(controls),
            Ok(News::Controls(_) | News::Garbled) => teller.garbled(),
            Err(Gone) => {
                teller.present(false);
                loop {
                    if !goes_on(REOPEN_EVERY) {
                        return;
                    }
                    if source.reopen() {
                        break;
                    }
                }
                teller.present(true);
                // Whatever it was told before, it has forgotten.
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
