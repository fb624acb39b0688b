//! The send queue of the operations stream.

use std::collections::VecDeque;

use crate::ProtocolError;
use crate::codec::{self, Message};
use crate::session::STREAM_BACKLOG_MAX_BYTES;

/// Encoded frames in order, bounded by [`STREAM_BACKLOG_MAX_BYTES`].
#[derive(Debug, Default)]
pub(super) struct Outbox {
    frames: VecDeque<Vec<u8>>,
    bytes: usize,
}

impl Outbox {
    pub(super) fn push_bytes(&mut self, frame: Vec<u8>) -> Result<(), ProtocolError> {
        let bytes = self.bytes + frame.len();
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
        self.bytes -= frame.len();
        Some(frame)
    }
}
