//! The view's end of the line.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtrb::{Consumer, Producer, RingBuffer};
use thiserror::Error;

use super::PointerEvent;

/// Events on their way: at 1000 a second, the most that mice send, a quarter of a second. A loop that is away for
/// longer loses the newest, which are counted; what it finds then is too old to press anything with.
pub const EVENTS_MAX: usize = 256;

/// What became of events so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PointerCounts {
    /// Heeded.
    pub heeded: u64,
    /// Left out, because a number in them can not be.
    pub unsound: u64,
    /// Left out, because a later one had come before.
    pub out_of_order: u64,
    /// Heeded in part, because they were too old: they let go and press nothing.
    pub old: u64,
}

#[derive(Debug, Default)]
pub(super) struct Counters {
    pub(super) heeded: AtomicU64,
    pub(super) unsound: AtomicU64,
    pub(super) out_of_order: AtomicU64,
    pub(super) old: AtomicU64,
}

/// There is no room for another event: the device is not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "the pointer's events are not heeded: {EVENTS_MAX} wait already; the force loop is held up or over"
)]
pub struct PointerFull;

/// Where a view hands in what happens to the pointer. While there is none the device counts as unplugged, so a view
/// whose own connection comes and goes (a page that is loaded again) keeps it, and says that the pointer left.
#[derive(Debug)]
pub struct PointerHandle {
    events: Producer<PointerEvent>,
    counters: Arc<Counters>,
}

impl PointerHandle {
    /// Hands in an event. It never waits.
    pub fn send(&mut self, event: PointerEvent) -> Result<(), PointerFull> {
        self.events.push(event).map_err(|_| PointerFull)
    }

    /// What became of the events so far.
    pub fn counts(&self) -> PointerCounts {
        let count = |c: &AtomicU64| c.load(Ordering::Relaxed);
        PointerCounts {
            heeded: count(&self.counters.heeded),
            unsound: count(&self.counters.unsound),
            out_of_order: count(&self.counters.out_of_order),
            old: count(&self.counters.old),
        }
    }
}

/// A line from a view to a device.
pub(super) fn line() -> (PointerHandle, Consumer<PointerEvent>, Arc<Counters>) {
    let (events, heard) = RingBuffer::new(EVENTS_MAX);
    let counters = Arc::<Counters>::default();
    let handle = PointerHandle {
        events,
        counters: Arc::clone(&counters),
    };
    (handle, heard, counters)
}
