//! Events in order of time: packets in flight, timers.

use std::collections::BTreeMap;

/// A queue of events; equal times keep the order of insertion. `Time` is virtual (µs) or that of a clock.
#[derive(Debug, Clone)]
pub(crate) struct EventQueue<Time, Event> {
    events: BTreeMap<(Time, u64), Event>,
    next_order: u64,
}

impl<Time, Event> Default for EventQueue<Time, Event> {
    fn default() -> Self {
        Self {
            events: BTreeMap::new(),
            next_order: 0,
        }
    }
}

impl<Time: Ord + Copy, Event> EventQueue<Time, Event> {
    pub(crate) fn push(&mut self, at: Time, event: Event) {
        self.events.insert((at, self.next_order), event);
        self.next_order += 1;
    }

    pub(crate) fn next_at(&self) -> Option<Time> {
        self.events.first_key_value().map(|((at, _), _)| *at)
    }

    /// Takes the next event that is due by `until`, with its time.
    pub(crate) fn pop_due(&mut self, until: Time) -> Option<(Time, Event)> {
        let first = self.events.first_entry()?;
        let at = first.key().0;
        (at <= until).then(|| (at, first.remove()))
    }

    pub(crate) fn retain(&mut self, mut keep: impl FnMut(&Event) -> bool) {
        self.events.retain(|_, event| keep(event));
    }

    pub(crate) fn len(&self) -> usize {
        self.events.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_taken_in_order_of_time_and_ties_in_order_of_insertion() {
        let mut queue = EventQueue::default();
        for (at, name) in [(3, "c"), (1, "a"), (3, "d"), (2, "b"), (9, "e")] {
            queue.push(at, name);
        }
        queue.retain(|name| *name != "b");
        assert_eq!((queue.len(), queue.next_at()), (4, Some(1)));
        let due: Vec<_> = std::iter::from_fn(|| queue.pop_due(3)).collect();
        assert_eq!(due, [(1, "a"), (3, "c"), (3, "d")]);
        assert_eq!(queue.next_at(), Some(9));
    }
}
