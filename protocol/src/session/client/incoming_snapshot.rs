//! A snapshot that arrives in pieces.

use crate::ProtocolError;
use crate::handshake::{SNAPSHOT_MAX_BYTES, SnapshotInfo};

/// A snapshot of which pieces are missing. It grows with the pieces, not with the announced size.
pub(super) struct IncomingSnapshot {
    size: usize,
    bytes: Vec<u8>,
}

/// A snapshot after one more piece.
pub(super) enum Progress {
    Partial(IncomingSnapshot),
    Complete(Vec<u8>),
}

impl IncomingSnapshot {
    /// The announced snapshot, without any piece.
    pub(super) fn new(info: SnapshotInfo) -> Result<Self, ProtocolError> {
        if !(1..=SNAPSHOT_MAX_BYTES).contains(&info.bytes) {
            return Err(out_of_range(format!(
                "{} bytes, at least 1 and at most {SNAPSHOT_MAX_BYTES}",
                info.bytes
            )));
        }
        Ok(Self {
            size: info.bytes as usize,
            bytes: Vec::new(),
        })
    }

    /// Appends the next piece.
    pub(super) fn push(mut self, piece: &[u8]) -> Result<Progress, ProtocolError> {
        self.bytes.extend_from_slice(piece);
        let (found, size) = (self.bytes.len(), self.size);
        if piece.is_empty() || found > size {
            return Err(out_of_range(format!(
                "{found} of {size} bytes after a piece of {}",
                piece.len()
            )));
        }
        Ok(if found == size {
            Progress::Complete(self.bytes)
        } else {
            Progress::Partial(self)
        })
    }
}

fn out_of_range(detail: String) -> ProtocolError {
    let what = "the size of the snapshot";
    ProtocolError::OutOfRange { what, detail }
}
