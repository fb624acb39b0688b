//! What every datagram begins with, as short as both ends can complete it.

use super::bytes::{Reader, Writer};
use super::{Moment, quantise};
use crate::{Epoch, ParticipantId, ProtocolError, ServerTime, Span};

const KIND_MASK: u8 = 0x0f;
const HAS_ACKNOWLEDGEMENT: u8 = 0x10;
const HAS_WHOLE_TIME: u8 = 0x20;

/// A time that is not whole may be so far from the newest that arrived: somewhat less than half of what 16
/// bits span at steps of 20 µs, 1.3 s.
pub const SHORT_TIME: Span = Span::from_millis(500);

/// The low bytes of an epoch and of a participant. QUIC keeps connections apart; this finds mistakes:
/// the next epoch differs from the one before, and so do neighbours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tag {
    /// The life of the session; an earlier one is refused.
    pub epoch: u8,
    /// The participant whose connection this is.
    pub stream: u8,
}

impl Tag {
    /// The tag of a connection.
    pub const fn new(epoch: Epoch, stream: ParticipantId) -> Self {
        Self {
            epoch: epoch.0 as u8,
            stream: stream.0 as u8,
        }
    }
}

/// What arrived from the other side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Acknowledgement {
    /// The newest number that arrived.
    pub newest: u32,
    /// Bit i: number `newest` - 1 - i arrived.
    pub bits: u32,
}

/// What every datagram begins with, after its kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Which session and which connection.
    pub tag: Tag,
    /// Counts the datagrams of this direction.
    pub sequence: u32,
    /// When the datagram was made, in server time as the sender knows it, to steps of
    /// [`TIME_STEP_US`](super::TIME_STEP_US). Of motion: when the newest sample of its first tool
    /// was taken.
    pub generated: ServerTime,
    /// Whether the time is sent whole: wherever it is more than [`SHORT_TIME`] from the newest that the
    /// other side has acknowledged.
    pub whole_time: bool,
    /// What arrived from the other side, in some of the datagrams.
    pub acknowledged: Option<Acknowledgement>,
}

/// What a receiver knows that completes a header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Expected {
    /// The newest number that arrived.
    pub sequence: u32,
    /// The time in the newest that arrived.
    pub generated: ServerTime,
    /// The newest number that was sent the other way.
    pub sent: u32,
}

impl Expected {
    /// The time of which these are the low bits and which is nearest to what is expected.
    fn time(&self, low: u16) -> i64 {
        let near = quantise::time(self.generated);
        near.saturating_add(i64::from(low.wrapping_sub(near as u16) as i16))
    }
}

/// The number of which these are the low bits and which is nearest.
fn nearest(low: u16, near: u32) -> u32 {
    near.wrapping_add(i32::from(low.wrapping_sub(near as u16) as i16) as u32)
}

impl Header {
    pub(super) fn moment(&self) -> Moment {
        Moment {
            sequence: self.sequence,
            stream: self.tag.stream,
            generated: self.generated,
        }
    }

    pub(super) fn write(&self, kind: u8, w: &mut Writer) {
        let acknowledgement = self.acknowledged.map_or(0, |_| HAS_ACKNOWLEDGEMENT);
        let whole = if self.whole_time { HAS_WHOLE_TIME } else { 0 };
        w.u8(kind | acknowledgement | whole);
        w.u8(self.tag.epoch);
        w.u8(self.tag.stream);
        w.u16(self.sequence as u16);
        let time = quantise::time(self.generated);
        if self.whole_time {
            w.i64(time);
        } else {
            w.u16(time as u16);
        }
        if let Some(a) = self.acknowledged {
            w.u16(a.newest as u16);
            w.u32(a.bits);
        }
    }

    /// The header and the kind.
    pub(super) fn read(
        r: &mut Reader<'_>,
        expected: &Expected,
    ) -> Result<(Self, u8), ProtocolError> {
        let kind = r.u8()?;
        if kind & !(KIND_MASK | HAS_ACKNOWLEDGEMENT | HAS_WHOLE_TIME) != 0 {
            return Err(ProtocolError::DatagramKind { kind });
        }
        let tag = Tag {
            epoch: r.u8()?,
            stream: r.u8()?,
        };
        let sequence = nearest(r.u16()?, expected.sequence);
        let whole_time = kind & HAS_WHOLE_TIME != 0;
        let time = if whole_time {
            r.i64()?
        } else {
            expected.time(r.u16()?)
        };
        let acknowledged = if kind & HAS_ACKNOWLEDGEMENT == 0 {
            None
        } else {
            Some(Acknowledgement {
                newest: nearest(r.u16()?, expected.sent),
                bits: r.u32()?,
            })
        };
        let header = Self {
            tag,
            sequence,
            generated: quantise::time_back(time),
            whole_time,
            acknowledged,
        };
        Ok((header, kind & KIND_MASK))
    }
}
