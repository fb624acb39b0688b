//! The send queue of the operations stream.

use std::collections::VecDeque;

use crate::codec::{self, Message};
use crate::session::{OUTBOX_HIGH_WATER_BYTES, STREAM_BACKLOG_MAX_BYTES, STREAM_STALL_MAX};
use crate::{ProtocolError, ServerTime};

/// Memory of a queued frame beside its bytes: its entry in a queue that may be half empty, and the
/// allocator's share. Most frames are shorter than that.
const FRAME_OVERHEAD_BYTES: usize = 64;

/// Encoded frames in order, bounded by [`STREAM_BACKLOG_MAX_BYTES`].
#[derive(Debug, Default)]
pub(super) struct Outbox {
    frames: VecDeque<Vec<u8>>,
    /// Memory of the frames.
    bytes: usize,
    /// Frames that have left.
    popped: u64,
    /// Since when frames have waited, and the frames that had left by then.
    waits: Option<(ServerTime, u64)>,
}

impl Outbox {
    pub(super) fn push_bytes(&mut self, frame: Vec<u8>) -> Result<(), ProtocolError> {
        let bytes = self.bytes + frame.len() + FRAME_OVERHEAD_BYTES;
        if bytes > STREAM_BACKLOG_MAX_BYTES {
            return Err(ProtocolError::Backlog {
                bytes,
                limit: STREAM_BACKLOG_MAX_BYTES,
            });
        }
        self.bytes = bytes;
        self.frames.push_back(frame);
        Ok(())
    }

    pub(super) fn push<M: Message>(&mut self, message: &M) -> Result<(), ProtocolError> {
        self.push_bytes(codec::encode_frame(message)?)
    }

    pub(super) fn pop(&mut self) -> Option<Vec<u8>> {
        let frame = self.frames.pop_front()?;
        self.bytes -= frame.len() + FRAME_OVERHEAD_BYTES;
        self.popped += 1;
        if self.frames.is_empty() {
            self.waits = None;
        }
        Some(frame)
    }

    /// Whether it is below its high-water mark.
    pub(super) fn has_room(&self) -> bool {
        self.bytes < OUTBOX_HIGH_WATER_BYTES
    }

    /// Notes the time at which frames began to wait; to be called after each input.
    pub(super) fn note(&mut self, now: ServerTime) {
        if !self.frames.is_empty() {
            self.waits.get_or_insert((now, self.popped));
        }
    }

    /// When [`is_stalled`](Self::is_stalled) must be asked; `None` while nothing waits.
    pub(super) fn due(&self) -> Option<ServerTime> {
        self.waits.map(|(since, _)| since + STREAM_STALL_MAX)
    }

    /// Whether frames have waited for [`STREAM_STALL_MAX`] and none has left.
    pub(super) fn is_stalled(&mut self, now: ServerTime) -> bool {
        if self.due().is_none_or(|due| now < due) {
            return false;
        }
        let before = self.waits.replace((now, self.popped));
        before.is_some_and(|(_, popped)| popped == self.popped)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::codec::FRAME_MAX_BYTES;

    proptest! {
        #[test]
        fn memory_stays_below_the_high_water_mark_and_one_frame(
            lengths in prop::collection::vec(1..=FRAME_MAX_BYTES, 1..60),
            short in prop::collection::vec(1..40_usize, 0..5000),
            takes in 0..100_usize,
        ) {
            let mut outbox = Outbox::default();
            for len in short.into_iter().chain(lengths) {
                while !outbox.has_room() {
                    for _ in 0..=takes {
                        outbox.pop();
                    }
                }
                outbox.push_bytes(vec![0; len]).unwrap();
                let held: usize = outbox.frames.iter().map(Vec::len).sum();
                let overhead = FRAME_OVERHEAD_BYTES * outbox.frames.len();
                prop_assert_eq!(outbox.bytes, held + overhead);
                let limit = OUTBOX_HIGH_WATER_BYTES + FRAME_MAX_BYTES + FRAME_OVERHEAD_BYTES;
                prop_assert!(outbox.bytes <= limit);
            }
            while outbox.pop().is_some() {}
            prop_assert_eq!((outbox.bytes, outbox.due()), (0, None));
        }
    }
}
