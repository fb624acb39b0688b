//! Copies of stream messages as datagrams.
//!
//! A lost packet holds back everything behind it on the stream until the loss is noticed and the packet is sent again:
//! more than a round trip. Short messages therefore leave again in datagrams some milliseconds later. The receiver passes on
//! what arrives first, in the order of the stream.

use std::collections::{BTreeMap, VecDeque};

use crate::Span;

/// From an operation or a refusal to its copies: in another packet, and after a short burst of losses.
pub const OPERATION_COPIES_AFTER: &[Span] = &[Span::from_millis(2), Span::from_millis(10)];

/// From a request to its copy, in the packet of the next motion. Most parts of a stroke open nothing, so that requests are six
/// times as frequent as operations and have one copy only.
pub const REQUEST_COPIES_AFTER: &[Span] = &[Span::from_millis(2)];

/// Longer messages have no copies: it must fit a datagram with its header.
pub const COPY_MAX_BYTES: usize = 1024;

/// Most messages whose copies wait at either end; the copies of further ones are dropped.
pub(super) const COPIES_MAX: u32 = 64;

/// A copy: the number of the message on the stream, from 0, and its bytes as in its frame.
pub type MessageCopy = (u32, Vec<u8>);

/// Copies that wait to be sent.
#[derive(Debug)]
pub(super) struct OutgoingCopies {
    /// From a message to each of its copies.
    after: &'static [Span],
    /// Messages so far.
    sent: u32,
    waiting: VecDeque<Waiting>,
}

/// A message whose copies wait.
#[derive(Debug)]
struct Waiting {
    /// When the message left, on the sender's clock; `None` until then.
    left: Option<Span>,
    /// Copies that were sent.
    copies: usize,
    copy: MessageCopy,
}

impl OutgoingCopies {
    pub(super) fn new(after: &'static [Span]) -> Self {
        Self {
            after,
            sent: 0,
            waiting: VecDeque::new(),
        }
    }

    /// Counts a message, and adds its copies if they are wanted and short.
    pub(super) fn push(&mut self, message: &[u8], is_wanted: bool) {
        let has_room = self.waiting.len() < COPIES_MAX as usize;
        if is_wanted && has_room && message.len() <= COPY_MAX_BYTES {
            self.waiting.push_back(Waiting {
                left: None,
                copies: 0,
                copy: (self.sent, message.to_vec()),
            });
        }
        self.sent = self.sent.wrapping_add(1);
    }

    /// Notes that the messages so far leave now. One that left later than now did so by a clock that was set back.
    pub(super) fn note(&mut self, now: Span) {
        for waiting in &mut self.waiting {
            waiting.left = Some(waiting.left.map_or(now, |left| left.min(now)));
        }
    }

    /// The next copy that is due.
    pub(super) fn poll(&mut self, now: Span) -> Option<MessageCopy> {
        let (_, i) = self.next().filter(|(due, _)| *due <= now)?;
        let waiting = &mut self.waiting[i];
        waiting.copies += 1;
        if waiting.copies < self.after.len() {
            return Some(waiting.copy.clone());
        }
        self.waiting.remove(i).map(|waiting| waiting.copy)
    }

    /// When the next copy is due.
    pub(super) fn due(&self) -> Option<Span> {
        self.next().map(|(due, _)| due)
    }

    /// When the next copy is due, and whose it is.
    fn next(&self) -> Option<(Span, usize)> {
        let due = |(i, w): (usize, &Waiting)| Some((w.left? + *self.after.get(w.copies)?, i));
        self.waiting.iter().enumerate().filter_map(due).min()
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
    fn copies_leave_after_their_message() {
        let mut copies = OutgoingCopies::new(OPERATION_COPIES_AFTER);
        let ms = Span::from_millis;
        copies.push(&[1], false);
        copies.push(&[2], true);
        copies.note(ms(5));
        copies.push(&[3], true);
        copies.push(&[0; COPY_MAX_BYTES + 1], true);
        copies.note(ms(10));
        let mut left = Vec::new();
        for t in 0..30 {
            while let Some((number, _)) = copies.poll(ms(t)) {
                left.push((t, number));
            }
        }
        assert_eq!(left, [(7, 1), (12, 2), (15, 1), (20, 2)]);
        assert_eq!(copies.due(), None);
    }

    #[test]
    fn clock_that_is_set_back_delays_no_copy() {
        let mut copies = OutgoingCopies::new(OPERATION_COPIES_AFTER);
        copies.push(&[1], true);
        copies.note(Span::from_millis(3_600_000));
        copies.note(Span::ZERO);
        for &after in OPERATION_COPIES_AFTER {
            assert_eq!(copies.poll(after), Some((0, vec![1])));
        }
    }
}
