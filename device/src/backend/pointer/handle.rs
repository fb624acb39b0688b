//! The view's end of the event queue.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rtrb::{Consumer, Producer, RingBuffer};
use thiserror::Error;

use super::PointerEvent;

/// Capacity of the queue: a quarter of a second at 1000 events a second, the maximum of mice. If the loop pauses
/// longer, the newest events are lost and counted; the older ones are too old to press a button.
pub const EVENTS_MAX: usize = 256;

/// Counters of events.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PointerCounts {
    /// Accepted.
    pub heeded: u64,
    /// Rejected, because a number is invalid.
    pub unsound: u64,
    /// Rejected, because a later event came first.
    pub out_of_order: u64,
    /// Accepted in part: too old events release buttons but press none.
    pub old: u64,
}

#[derive(Debug, Default)]
pub(super) struct Counters {
    pub(super) heeded: AtomicU64,
    pub(super) unsound: AtomicU64,
    pub(super) out_of_order: AtomicU64,
    pub(super) old: AtomicU64,
}

/// The queue is full: the device is not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "the pointer's event queue is full ({EVENTS_MAX} events); the force loop is held up or has ended"
)]
pub struct PointerFull;

/// Sender of pointer events. Without it the device counts as unplugged. A view whose connection comes and goes (a
/// reloaded page) keeps it, and sends that the pointer left.
#[derive(Debug)]
pub struct PointerHandle {
    events: Producer<PointerEvent>,
    counters: Arc<Counters>,
}

impl PointerHandle {
    /// Sends an event, without waiting.
    pub fn send(&mut self, event: PointerEvent) -> Result<(), PointerFull> {
        self.events.push(event).map_err(|_| PointerFull)
    }

    /// Counters of the events so far.
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

/// A queue from a view to a device.
pub(super) fn line() -> (PointerHandle, Consumer<PointerEvent>, Arc<Counters>) {
    let (events, heard) = RingBuffer::new(EVENTS_MAX);
    let counters = Arc::<Counters>::default();
    let handle = PointerHandle {
        events,
        counters: Arc::clone(&counters),
    };
    (handle, heard, counters)
}
