//! Copies of stream messages as datagrams.
//!
//! A lost packet holds back everything behind it on the stream until the loss is noticed and the packet is sent again:
//! more than a round trip. Requests and operations therefore leave a second time, in a datagram [`COPY_AFTER`] later.
//! The receiver takes the one that arrives first, and keeps the order of the numbers.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::Span;

/// From a message to its copy: long enough for another packet, and for the end of a short burst of losses.
pub const COPY_AFTER: Span = Span::from_millis(10);

/// Longer messages have no copy: it must fit a datagram with its header.
pub const COPY_MAX_BYTES: usize = 1024;

/// Most copies that wait at either end; further ones are dropped.
const COPIES_MAX: usize = 64;

/// Copies that wait to be sent.
#[derive(Debug, Default)]
pub(super) struct OutgoingCopies {
    /// When each is due, on the sender's clock; `None` until its message has left.
    waiting: VecDeque<(Option<Span>, Vec<u8>)>,
}

impl OutgoingCopies {
    /// Adds the copy of a message, if it is short.
    pub(super) fn push(&mut self, message: &[u8]) {
        if message.len() <= COPY_MAX_BYTES && self.waiting.len() < COPIES_MAX {
            self.waiting.push_back((None, message.to_vec()));
        }
    }

    /// Notes that the messages so far leave now.
    pub(super) fn note(&mut self, now: Span) {
        let new = self.waiting.iter_mut().rev().map(|(due, _)| due);
        for due in new.take_while(|due| due.is_none()) {
            *due = Some(now + COPY_AFTER);
        }
    }

    /// The next copy that is due.
    pub(super) fn poll(&mut self, now: Span) -> Option<Vec<u8>> {
        let is_due = self.due().is_some_and(|due| due <= now);
        let first = is_due.then(|| self.waiting.pop_front());
        first.flatten().map(|(_, message)| message)
    }

    /// When the next copy is due.
    pub(super) fn due(&self) -> Option<Span> {
        self.waiting.front().and_then(|(due, _)| *due)
    }
}

/// Numbered messages of a stream and their copies, in order.
#[derive(Debug)]
pub(super) struct IncomingCopies<M> {
    /// Number of the newest message that was passed on; `None` before the first one.
    newest: Option<u64>,
    /// Copies that wait for one before them.
    early: BTreeMap<u64, M>,
    /// Messages that were passed on as copies and have not come on the stream.
    ahead: BTreeSet<u64>,
}

impl<M> IncomingCopies<M> {
    pub(super) fn after(newest: Option<u64>) -> Self {
        Self {
            newest,
            early: BTreeMap::new(),
            ahead: BTreeSet::new(),
        }
    }

    /// Whether a message of the stream is new, and not passed on as a copy before.
    pub(super) fn is_new(&mut self, number: u64) -> bool {
        let is_new = !self.ahead.remove(&number);
        if is_new {
            self.newest = self.newest.max(Some(number));
            self.early.retain(|early, _| Some(*early) > self.newest);
        }
        is_new
    }

    /// Adds a copy.
    pub(super) fn push(&mut self, number: u64, message: M) {
        if Some(number) > self.newest && self.early.len() + self.ahead.len() < COPIES_MAX {
            self.early.insert(number, message);
        }
    }

    /// The next copy without a gap before it.
    pub(super) fn pop(&mut self) -> Option<M> {
        let next = self.newest?.checked_add(1)?;
        let message = self.early.remove(&next)?;
        self.newest = Some(next);
        self.ahead.insert(next);
        Some(message)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Any delay of the stream and any order, loss and repetition of copies give each message once, in order.
        #[test]
        fn messages_are_passed_on_once_and_in_order(
            gaps in prop::collection::vec(1_u64..3, 1..150),
            arrivals in prop::collection::vec((any::<usize>(), any::<bool>()), 0..400),
        ) {
            let numbers: Vec<u64> = gaps.iter().scan(0, |n, gap| { *n += gap; Some(*n) }).collect();
            let mut incoming = IncomingCopies::after(Some(0));
            let (mut stream, mut got) = (numbers.iter().copied(), Vec::new());
            let end = std::iter::repeat_n((0, true), numbers.len());
            for (copy, is_stream) in arrivals.into_iter().chain(end) {
                if is_stream {
                    let Some(number) = stream.next() else { continue };
                    if incoming.is_new(number) {
                        got.push(number);
                    }
                } else {
                    let number = numbers[copy % numbers.len()];
                    incoming.push(number, number);
                }
                got.extend(std::iter::from_fn(|| incoming.pop()));
                prop_assert!(incoming.early.len() + incoming.ahead.len() <= COPIES_MAX);
            }
            prop_assert_eq!(got, numbers);
            prop_assert!(incoming.early.is_empty() && incoming.ahead.is_empty());
        }
    }

    #[test]
    fn copy_leaves_after_its_message() {
        let mut copies = OutgoingCopies::default();
        let at = Span::from_millis(5);
        copies.push(&[1]);
        copies.note(at);
        assert_eq!(
            (copies.poll(at), copies.due()),
            (None, Some(at + COPY_AFTER))
        );
        copies.push(&[0; COPY_MAX_BYTES + 1]);
        assert_eq!(copies.poll(at + COPY_AFTER), Some(vec![1]));
        assert_eq!((copies.poll(at + COPY_AFTER), copies.due()), (None, None));
    }
}
