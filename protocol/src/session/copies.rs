//! Copies of stream messages as datagrams.
//!
//! A lost packet holds back everything behind it on the stream until the loss is noticed and the packet is sent again:
//! more than a round trip. Short messages therefore leave again in datagrams some milliseconds later. The receiver passes on
//! what arrives first, in the order of the stream.

use std::collections::{BTreeMap, VecDeque};

use crate::Span;

/// From a message to the first of several copies, in the packet of the next motion.
const FIRST_COPY_AFTER: Span = Span::from_millis(2);

/// Between several copies: each leaves in another packet of motion.
const COPY_INTERVAL: Span = Span::from_millis(4);

/// Least time from a message to its last or only copy: longer than a short burst of losses.
const LAST_COPY_AFTER: Span = Span::from_millis(10);

/// Most copies of a message.
const COPIES_PER_MESSAGE_MAX: u32 = 4;

/// Largest probability that a message and all of its copies are lost, if losses are independent: one in an hour of cutting.
const ALL_LOST_MAX: f64 = 3e-5;

/// Longer messages have no copies: it must fit a datagram with its header.
pub const COPY_MAX_BYTES: usize = 1024;

/// Most messages whose copies wait at either end; the copies of further ones are dropped.
pub(super) const COPIES_MAX: u32 = 64;

/// A copy: the number of the message on the stream, from 0, and its bytes as in its frame.
pub type MessageCopy = (u32, Vec<u8>);

/// The fewest copies that a message needs on a link with this share of lost datagrams.
fn copies_needed(loss: f64) -> u32 {
    (1..COPIES_PER_MESSAGE_MAX)
        .find(|n| loss.powi(*n as i32 + 1) <= ALL_LOST_MAX)
        .unwrap_or(COPIES_PER_MESSAGE_MAX)
}

/// Copies that wait to be sent.
#[derive(Debug, Default)]
pub(super) struct OutgoingCopies {
    /// Messages so far.
    sent: u32,
    waiting: VecDeque<Waiting>,
}

/// A message whose copies wait.
#[derive(Debug)]
struct Waiting {
    /// When the message left, on the sender's clock; `None` until then.
    left: Option<Span>,
    /// Copies that the message needs.
    needed: u32,
    /// Copies that were sent.
    sent: u32,
    copy: MessageCopy,
}

impl Waiting {
    /// When the next copy is due.
    fn due(&self) -> Option<Span> {
        let intervals = i64::from(self.needed.max(2) - 1);
        let apart = Span::from_micros(COPY_INTERVAL.as_micros() * intervals);
        let last = LAST_COPY_AFTER.max(FIRST_COPY_AFTER + apart);
        let further = i64::from(self.needed - self.sent - 1);
        let before_last = (last - FIRST_COPY_AFTER).as_micros() * further / intervals;
        Some(self.left? + last - Span::from_micros(before_last))
    }
}

impl OutgoingCopies {
    /// Counts a message. Adds the copies that it needs on a link with this `loss` if it is short; `None` for no copies.
    pub(super) fn push(&mut self, message: &[u8], loss: Option<f64>) {
        let has_room = self.waiting.len() < COPIES_MAX as usize;
        let is_short = message.len() <= COPY_MAX_BYTES;
        if let Some(loss) = loss.filter(|_| has_room && is_short) {
            self.waiting.push_back(Waiting {
                left: None,
                needed: copies_needed(loss),
                sent: 0,
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
        waiting.sent += 1;
        if waiting.sent < waiting.needed {
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
        let due = |(i, w): (usize, &Waiting)| Some((w.due()?, i));
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
    fn more_copies_are_needed_on_a_link_with_more_loss() {
        let needed = [0.0, 0.005, 0.01, 0.03, 0.05, 0.1, 0.9].map(copies_needed);
        assert_eq!(needed, [1, 1, 2, 2, 3, 4, 4]);
    }

    #[test]
    fn copies_leave_after_their_message() {
        let mut copies = OutgoingCopies::default();
        let ms = Span::from_millis;
        copies.push(&[1], None);
        copies.push(&[2], Some(0.01));
        copies.note(ms(5));
        copies.push(&[3], Some(0.05));
        copies.push(&[4], Some(0.0));
        copies.push(&[0; COPY_MAX_BYTES + 1], Some(0.01));
        copies.push(&[5], Some(0.1));
        copies.note(ms(10));
        let mut left = Vec::new();
        for t in 0..30 {
            while let Some((number, _)) = copies.poll(ms(t)) {
                left.push((t, number));
            }
        }
        let of = |message| left.iter().filter(move |(_, n)| *n == message);
        let times = [1, 2, 3, 4, 5].map(|n| of(n).map(|(t, _)| *t).collect::<Vec<_>>());
        let expected = [&[7, 15][..], &[12, 16, 20], &[20], &[], &[12, 16, 20, 24]];
        assert_eq!(times, expected);
        assert_eq!(copies.due(), None);
    }

    #[test]
    fn clock_that_is_set_back_delays_no_copy() {
        let mut copies = OutgoingCopies::default();
        copies.push(&[1], Some(0.01));
        copies.note(Span::from_millis(3_600_000));
        copies.note(Span::ZERO);
        for after in [FIRST_COPY_AFTER, LAST_COPY_AFTER] {
            assert_eq!(copies.poll(after), Some((0, vec![1])));
        }
    }
}
