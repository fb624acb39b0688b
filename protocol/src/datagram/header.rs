//! The header of every datagram, truncated as far as the receiver can complete it.

use super::bytes::{Reader, Writer};
use super::{KIND_MOTION, Moment, quantise};
use crate::{Epoch, ParticipantId, ProtocolError, ServerTime, Span};

const KIND_MASK: u8 = 0x07;
const HAS_ACKNOWLEDGEMENT: u8 = 0x08;
const IS_WHOLE: u8 = 0x10;
const EPOCH_SHIFT: u32 = 5;
const STREAM_MASK: u8 = 0x0f;

/// Bits of a truncated sequence number: at 264 datagrams a second they repeat after 16 s. The receiver
/// drops numbers more than [`crate::WINDOW_BITS`] behind the newest, and QUIC drops packets some hundred
/// numbers behind.
const SEQUENCE_BITS: u32 = 12;

/// The largest distance of a truncated number from the newest that arrived: somewhat less than half of
/// the range of its bits.
pub const SHORT_SEQUENCE: u32 = 1500;

/// The largest distance of a truncated time from the newest that arrived: well below half of the range
/// of 16 bits at steps of 50 µs, 3.3 s.
pub const SHORT_TIME: Span = Span::from_millis(500);

/// The connection and the incarnation of the session. Three bits of the epoch and four of the
/// participant are sent. QUIC separates connections; these bits detect mistakes, because consecutive
/// epochs and neighbouring participants differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tag {
    /// The incarnation of the session; earlier ones are rejected.
    pub epoch: Epoch,
    /// The participant whose connection this is.
    pub stream: ParticipantId,
}

impl Tag {
    fn epoch_bits(self) -> u8 {
        (self.epoch.0 as u8) << EPOCH_SHIFT
    }

    fn stream_bits(self) -> u8 {
        self.stream.0 as u8 & STREAM_MASK
    }
}

/// The datagrams that arrived from the other side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Acknowledgement {
    /// The newest number that arrived.
    pub newest: u32,
    /// Bit i: number `newest` - 1 - i arrived.
    pub bits: u32,
}

/// The header of every datagram, after its kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// The session and the connection.
    pub tag: Tag,
    /// Counts the datagrams of this direction.
    pub sequence: u32,
    /// The time of creation in the sender's estimate of server time, in steps of
    /// [`TIME_STEP_US`](super::TIME_STEP_US). For motion this field is ignored: the time is that of the
    /// newest sample of the first tool.
    pub generated: ServerTime,
    /// Whether number and time are sent whole: required if they are more than [`SHORT_SEQUENCE`] or
    /// [`SHORT_TIME`] from the newest acknowledged ones.
    pub is_whole: bool,
    /// The acknowledgement, in some of the datagrams.
    pub acknowledged: Option<Acknowledgement>,
}

/// The receiver's state that completes a header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Expected {
    /// Its own connection.
    pub tag: Tag,
    /// The newest number that arrived.
    pub sequence: u32,
    /// The time in the newest that arrived.
    pub generated: ServerTime,
    /// The newest number that was sent in the other direction.
    pub sent: u32,
}

/// The time in steps of which these are the low bits and which is nearest.
pub(super) fn nearest_time(low: u16, near: i64) -> i64 {
    near.saturating_add(i64::from(low.wrapping_sub(near as u16) as i16))
}

/// The number of which these are the low `bits` and which is nearest.
fn nearest(low: u16, bits: u32, near: u32) -> u32 {
    let unused = u16::BITS - bits;
    let ahead = (low.wrapping_sub(near as u16) << unused) as i16 >> unused;
    near.wrapping_add(i32::from(ahead) as u32)
}

impl Header {
    pub(super) fn moment(&self) -> Moment {
        Moment {
            sequence: self.sequence,
            stream: self.tag.stream,
            generated: self.generated,
            is_whole: self.is_whole,
        }
    }

    pub(super) fn write(&self, kind: u8, w: &mut Writer) {
        let acknowledgement = self.acknowledged.map_or(0, |_| HAS_ACKNOWLEDGEMENT);
        let whole = if self.is_whole { IS_WHOLE } else { 0 };
        w.u8(kind | acknowledgement | whole | self.tag.epoch_bits());
        let high = (self.sequence >> 8) as u8;
        w.u8(self.tag.stream_bits() | high << 4);
        w.u8(self.sequence as u8);
        let time = quantise::time(self.generated);
        if self.is_whole {
            w.u32(self.sequence);
            w.i64(time);
        } else if kind != KIND_MOTION {
            w.u16(time as u16);
        }
        if let Some(a) = self.acknowledged {
            w.u16(a.newest as u16);
            w.u32(a.bits);
        }
    }

    /// The header and the kind. Of motion that is not whole the time is in the body.
    pub(super) fn read(
        r: &mut Reader<'_>,
        expected: &Expected,
    ) -> Result<(Self, u8), ProtocolError> {
        let first = r.u8()?;
        let kind = first & KIND_MASK;
        let tag = expected.tag;
        let epoch = first >> EPOCH_SHIFT << EPOCH_SHIFT;
        if epoch != tag.epoch_bits() {
            return Err(ProtocolError::OtherEpoch {
                expected: tag.epoch.0,
                low_bits: epoch >> EPOCH_SHIFT,
            });
        }
        let second = r.u8()?;
        let stream = second & STREAM_MASK;
        if stream != tag.stream_bits() {
            return Err(ProtocolError::OtherStream {
                expected: tag.stream.0,
                low_bits: stream,
            });
        }
        let low = u16::from(second >> 4) << 8 | u16::from(r.u8()?);
        let is_whole = first & IS_WHOLE != 0;
        let (sequence, time) = if is_whole {
            let sequence = r.u32()?;
            if nearest(low, SEQUENCE_BITS, sequence) != sequence {
                return Err(ProtocolError::OutOfRange {
                    what: "a whole number",
                    detail: format!("{sequence}, whose low bits are sent as {low}"),
                });
            }
            (sequence, r.i64()?)
        } else {
            let sequence = nearest(low, SEQUENCE_BITS, expected.sequence);
            let near = quantise::time(expected.generated);
            let time = if kind == KIND_MOTION {
                near
            } else {
                nearest_time(r.u16()?, near)
            };
            (sequence, time)
        };
        let acknowledged = if first & HAS_ACKNOWLEDGEMENT == 0 {
            None
        } else {
            Some(Acknowledgement {
                newest: nearest(r.u16()?, u16::BITS, expected.sent),
                bits: r.u32()?,
            })
        };
        let header = Self {
            tag,
            sequence,
            generated: quantise::time_back(time),
            is_whole,
            acknowledged,
        };
        Ok((header, kind))
    }
}
