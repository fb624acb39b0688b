//! Reads and writes little-endian bytes with bounds checks.

use crate::ProtocolError;

/// Collects the bytes of one datagram.
pub(super) struct Writer(Vec<u8>);

macro_rules! put {
    ($($name:ident: $t:ty),*) => {$(
        pub(super) fn $name(&mut self, v: $t) {
            self.0.extend_from_slice(&v.to_le_bytes());
        }
    )*};
}

impl Writer {
    pub(super) fn with_capacity(bytes: usize) -> Self {
        Self(Vec::with_capacity(bytes))
    }

    put!(u8: u8, u16: u16, u32: u32, i64: i64);

    pub(super) fn into_vec(self) -> Vec<u8> {
        self.0
    }
}

/// Reads a datagram from front to back.
pub(super) struct Reader<'a> {
    rest: &'a [u8],
    what: &'static str,
}

macro_rules! take {
    ($($name:ident: $t:ty),*) => {$(
        pub(super) fn $name(&mut self) -> Result<$t, ProtocolError> {
            self.array().map(<$t>::from_le_bytes)
        }
    )*};
}

impl<'a> Reader<'a> {
    pub(super) fn new(bytes: &'a [u8], what: &'static str) -> Self {
        Self { rest: bytes, what }
    }

    /// Names the part that is read from here on, for errors.
    pub(super) fn part(&mut self, what: &'static str) {
        self.what = what;
    }

    fn truncated(&self) -> ProtocolError {
        ProtocolError::DatagramTruncated { what: self.what }
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], ProtocolError> {
        let (head, rest) = self
            .rest
            .split_first_chunk()
            .ok_or_else(|| self.truncated())?;
        self.rest = rest;
        Ok(*head)
    }

    take!(u8: u8, u16: u16, u32: u32, i64: i64);

    /// The unread bytes.
    pub(super) fn rest(self) -> &'a [u8] {
        self.rest
    }

    /// Checks, before any allocation, that `count` items of at least `bytes` each can
    /// still follow.
    pub(super) fn expect_items(&self, count: usize, bytes: usize) -> Result<(), ProtocolError> {
        if self.rest.len() < count * bytes {
            Err(self.truncated())
        } else {
            Ok(())
        }
    }

    /// Nothing may follow.
    pub(super) fn finish(self) -> Result<(), ProtocolError> {
        if self.rest.is_empty() {
            return Ok(());
        }
        Err(ProtocolError::TrailingBytes {
            what: self.what,
            extra: self.rest.len(),
        })
    }
}
