//! Errors in bytes from the peer.

use crate::Span;
use crate::handshake::PROTOCOL_VERSION;

/// A violation of the protocol on the wire. It closes at most the one session
/// that it arrived on.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ProtocolError {
    /// The stream does not begin with the magic bytes.
    #[error(
        "the other side does not speak palpate: its stream begins with {found:02x?} instead of \"PALP\"; check the port"
    )]
    NotPalpate {
        /// The first four bytes that arrived.
        found: [u8; 4],
    },
    /// A page in a browser violated its format.
    #[error("{0}")]
    Page(String),
    /// Both sides use palpate, in different versions.
    #[error(
        "the other side speaks protocol version {theirs}, this program speaks version {PROTOCOL_VERSION}; use the same release on both sides"
    )]
    Version {
        /// The version in the peer's preamble.
        theirs: u16,
    },
    /// A frame announces more bytes than its kind may have.
    #[error("a frame of {bytes} bytes on the operations stream, where at most {limit} are allowed")]
    FrameTooLong {
        /// The length prefix in bytes.
        bytes: u64,
        /// The limit that applied, in bytes.
        limit: usize,
    },
    /// A frame's content is not a message.
    #[error("a frame of {bytes} bytes is not a valid {what}: {detail}")]
    BadFrame {
        /// The kind of message expected.
        what: &'static str,
        /// The length of the frame in bytes.
        bytes: usize,
        /// The decoder's message.
        detail: String,
    },
    /// A message ended before its frame did.
    #[error("a {what} is followed by {extra} extra bytes")]
    TrailingBytes {
        /// The kind of message.
        what: &'static str,
        /// How many bytes were left.
        extra: usize,
    },
    /// A message of this program that is too large to send.
    #[error("a {what} of {bytes} bytes is too large to send, at most {limit} are allowed")]
    TooLarge {
        /// The kind of message.
        what: &'static str,
        /// Its encoded size in bytes; 0 where it could not be encoded at all.
        bytes: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// A datagram that ends before its announced content.
    #[error("a {what} datagram is truncated")]
    DatagramTruncated {
        /// The part that was being read.
        what: &'static str,
    },
    /// A datagram whose baseline did not arrive or is forgotten.
    #[error("a datagram refers to the baseline {sequence}, which is unknown here")]
    NoBaseline {
        /// The number of the baseline.
        sequence: u32,
    },
    /// A datagram of another incarnation of the session.
    #[error(
        "a datagram of another epoch: its low bits are {low_bits}, the session is in epoch {expected}"
    )]
    OtherEpoch {
        /// The epoch of the session.
        expected: u32,
        /// The low bits of the epoch in the datagram.
        low_bits: u8,
    },
    /// A datagram of another participant's connection.
    #[error(
        "a datagram of another participant: its low bits are {low_bits}, the connection is that of #{expected}"
    )]
    OtherStream {
        /// The participant of this connection.
        expected: u16,
        /// The low bits of the participant in the datagram.
        low_bits: u8,
    },
    /// A datagram of a kind that this version does not know.
    #[error("a datagram has the unknown kind {kind}")]
    DatagramKind {
        /// The byte that names the kind.
        kind: u8,
    },
    /// A value in a datagram or message outside its declared range.
    #[error("{what} is out of range in a message: {detail}")]
    OutOfRange {
        /// Which value.
        what: &'static str,
        /// Its value and the range.
        detail: String,
    },
    /// A message that is not allowed at this point of the session.
    #[error("a {what} arrived while {state}")]
    OutOfOrder {
        /// The message that arrived.
        what: &'static str,
        /// The state of the session.
        state: &'static str,
    },
    /// A numbered operation is repeated.
    #[error(
        "operation {found} arrived where operation {expected} or a later one was due; rejoin the session"
    )]
    OperationOrder {
        /// The lowest number that was due.
        expected: u64,
        /// The number received.
        found: u64,
    },
    /// The peer takes its operations more slowly than they are produced.
    #[error(
        "{bytes} bytes of operations wait for this peer, more than the limit of {limit}; its connection is too slow to follow"
    )]
    Backlog {
        /// How many bytes wait.
        bytes: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// The peer takes nothing of its operations stream.
    #[error(
        "the operations stream took nothing for {} s while operations wait; this connection is too slow to follow", .waited.as_secs_f64()
    )]
    Stalled {
        /// How long nothing was taken.
        waited: Span,
    },
    /// The peer sends more requests than are answered or refused.
    #[error(
        "too many requests: {accepted} a second are answered and {refused} a second refused; send fewer"
    )]
    RequestFlood {
        /// The rate of accepted requests, per second.
        accepted: u32,
        /// The rate of refused requests, per second.
        refused: u32,
    },
}
