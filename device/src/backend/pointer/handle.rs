//! The view's end of the event queue.

use rtrb::{Consumer, Producer, RingBuffer};
use thiserror::Error;

use super::PointerEvent;

/// Capacity of the queue: a quarter of a second at 1000 events a second, the maximum of mice. If the loop pauses
/// longer, the newest events are lost; the older ones are too old to press a button.
pub const EVENTS_MAX: usize = 256;

/// The queue is full: the device is not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error(
    "the pointer's event queue is full ({EVENTS_MAX} events); the force loop is held up or has ended"
)]
pub struct PointerFull;

/// Sender of pointer events. Without it the device counts as unplugged. A view whose connection comes and goes (a
/// reloaded page) keeps it, and sends that the pointer left.
#[derive(Debug)]
pub struct PointerHandle(Producer<PointerEvent>);

impl PointerHandle {
    /// Sends an event, without waiting.
    pub fn send(&mut self, event: PointerEvent) -> Result<(), PointerFull> {
        self.0.push(event).map_err(|_| PointerFull)
    }
}

/// A queue from a view to a device.
pub(super) fn queue() -> (PointerHandle, Consumer<PointerEvent>) {
    let (events, received) = RingBuffer::new(EVENTS_MAX);
    (PointerHandle(events), received)
}
