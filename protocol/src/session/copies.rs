//! Copies of stream messages as datagrams.
//!
//! A lost packet holds back everything behind it on the stream until the loss is noticed and the packet is sent again:
//! more than a round trip. Short messages therefore leave a second time, in a datagram [`COPY_AFTER`] later. The receiver
//! passes on the one that arrives first, in the order of the stream.

use std::collections::{BTreeMap, VecDeque};

use crate::Span;

/// From a message to its copy: long enough for another packet, and for the end of a short burst of losses.
pub const COPY_AFTER: Span = Span::from_millis(10);

/// Longer messages have no copy: it must fit a datagram with its header.
pub const COPY_MAX_BYTES: usize = 1024;

/// Most copies that wait at either end; further ones are dropped.
pub(super) const COPIES_MAX: u32 = 64;

/// A copy: the number of the message on the stream, from 0, and its bytes as in its frame.
pub type MessageCopy = (u32, Vec<u8>);

/// Copies that wait to be sent.
#[derive(Debug, Default)]
pub(super) struct OutgoingCopies {
    /// Messages so far.
    sent: u32,
    /// When each is due, on the sender's clock; `None` until its message has left.
    waiting: VecDeque<(Option<Span>, MessageCopy)>,
}

impl OutgoingCopies {
    /// Counts a message, and adds its copy if it is wanted and short.
    pub(super) fn push(&mut self, message: &[u8], is_wanted: bool) {
        let has_room = self.waiting.len() < COPIES_MAX as usize;
        if is_wanted && has_room && message.len() <= COPY_MAX_BYTES {
            self.waiting
                .push_back((None, (self.sent, message.to_vec())));
        }
        self.sent = self.sent.wrapping_add(1);
    }

    /// Notes that the messages so far leave now. A due time beyond that of a message that leaves now is one of a clock that
    /// was set back.
    pub(super) fn note(&mut self, now: Span) {
        let latest = now + COPY_AFTER;
        for (due, _) in &mut self.waiting {
            *due = Some(due.map_or(latest, |due| due.min(latest)));
        }
    }

    /// The next copy that is due.
    pub(super) fn poll(&mut self, now: Span) -> Option<MessageCopy> {
        let is_due = self.due().is_some_and(|due| due <= now);
        let first = is_due.then(|| self.waiting.pop_front());
        first.flatten().map(|(_, copy)| copy)
    }

    /// When the next copy is due.
    pub(super) fn due(&self) -> Option<Span> {
        self.waiting.front().and_then(|(due, _)| *due)
    }
}

/// Messages of a stream and their copies, in the order of the stream.
#[derive(Debug)]
pub(super) struct IncomingCopies<M> {
    /// Messages that came on the stream.
    streamed: u32,
    /// Messages that were passed on.
    passed: u32,
    /// Copies that wait for a message before them.
    early: BTreeMap<u32, M>,
}

impl<M> Default for IncomingCopies<M> {
    fn default() -> Self {
        Self {
            streamed: 0,
            passed: 0,
            early: BTreeMap::new(),
        }
    }
}

impl<M> IncomingCopies<M> {
    /// Counts a message of the stream; whether it is new, and not passed on as a copy before.
    pub(super) fn is_new(&mut self) -> bool {
        let is_new = self.streamed == self.passed;
        self.streamed = self.streamed.wrapping_add(1);
        if is_new {
            self.early.remove(&self.passed);
            self.passed = self.streamed;
        }
        is_new
    }

    /// Adds a copy.
    pub(super) fn push(&mut self, number: u32, message: M) {
        let is_early = number >= self.passed && number.wrapping_sub(self.streamed) < COPIES_MAX;
        if is_early {
            self.early.insert(number, message);
        }
    }

    /// The next message, if its copy is there.
    pub(super) fn pop(&mut self) -> Option<M> {
        let message = self.early.remove(&self.passed)?;
        self.passed = self.passed.wrapping_add(1);
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
            count in 1_u32..150,
            arrivals in prop::collection::vec(prop_oneof![
                Just(None), (0_u32..150).prop_map(Some),
            ], 0..500),
        ) {
            let mut incoming = IncomingCopies::default();
            let (mut stream, mut got) = (0..count, Vec::new());
            let rest = std::iter::repeat_n(None, count as usize);
            for copy in arrivals.into_iter().chain(rest) {
                match copy {
                    Some(number) => incoming.push(number % count, number % count),
                    None => match stream.next() {
                        Some(number) if incoming.is_new() => got.push(number),
                        Some(_) => {}
                        None => continue,
                    },
                }
                got.extend(std::iter::from_fn(|| incoming.pop()));
                prop_assert!(incoming.early.len() <= COPIES_MAX as usize);
            }
            prop_assert_eq!(got, (0..count).collect::<Vec<_>>());
            prop_assert!(incoming.early.is_empty());
        }
    }

    #[test]
    fn copy_leaves_after_its_message() {
        let mut copies = OutgoingCopies::default();
        let at = Span::from_millis(5);
        copies.push(&[1], false);
        copies.push(&[2], true);
        copies.note(at);
        assert_eq!(
            (copies.poll(at), copies.due()),
            (None, Some(at + COPY_AFTER))
        );
        copies.push(&[0; COPY_MAX_BYTES + 1], true);
        assert_eq!(copies.poll(at + COPY_AFTER), Some((1, vec![2])));
        assert_eq!((copies.poll(at + COPY_AFTER), copies.due()), (None, None));
    }

    #[test]
    fn clock_that_is_set_back_delays_no_copy() {
        let mut copies = OutgoingCopies::default();
        copies.push(&[1], true);
        copies.note(Span::from_millis(3_600_000));
        copies.note(Span::ZERO);
        assert_eq!(copies.poll(COPY_AFTER), Some((0, vec![1])));
    }
}
