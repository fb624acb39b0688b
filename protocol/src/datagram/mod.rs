//! What may get lost: datagrams of at most [`DATAGRAM_MAX_BYTES`], packed by hand.
//!
//! All integers are little endian. Every datagram begins with the header
//!
//! ```text
//! kind u8 | epoch u32 | stream u16 | sequence u32 | generated i64 µs | newest u32 | bits u32
//! ```
//!
//! `stream` is the participant whose connection it is, in both directions; `sequence` counts the
//! datagrams of one direction; `newest` and `bits` acknowledge the other direction: bit i says that
//! number `newest` - 1 - i arrived. The body follows:
//!
//! | kind | body |
//! | --- | --- |
//! | 1 motion | tracks, see [`motion`] |
//! | 2 corrections | displacements, see [`corrections`] |
//! | 3 probe | id u32, client time i64 |
//! | 4 reply | id u32, client time i64, server received i64, server sent i64 |
//! | 5 delays | count u8, then {participant u16, mean u32, deviation u32, wanted u32} |
//!
//! Decoders never panic, never allocate more than the datagram could hold, and refuse what follows
//! a message.

mod bytes;
pub mod corrections;
pub mod motion;
mod quantise;

use bytes::{Reader, Writer};

pub use corrections::Corrections;
pub use quantise::{POSITION_MAX_M, POSITION_STEP_M};

use crate::request::DelayReport;
use crate::{ClientTime, Epoch, ParticipantId, ProtocolError, ServerTime, ToolTrack};

/// The largest datagram in bytes: below the smallest path that QUIC allows (1200 B of UDP payload)
/// with room for its own header. What does not fit goes into the next one.
pub const DATAGRAM_MAX_BYTES: usize = 1100;

/// Size of the header in bytes.
pub const HEADER_BYTES: usize = 27;

/// The most samples of one tool in one datagram: the newest batch of four 1 kHz samples and the
/// batch before, repeated.
pub const TRACK_MAX_SAMPLES: usize = 8;

/// The most tools in one datagram; a datagram that names more is refused.
pub const TRACKS_MAX: usize = 64;

/// The most delay reports in one datagram.
pub const DELAYS_MAX: usize = 64;

/// What every datagram begins with, after the kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// The life of the session; an earlier one is refused.
    pub epoch: Epoch,
    /// The participant whose connection this is.
    pub stream: ParticipantId,
    /// Counts the datagrams of this direction.
    pub sequence: u32,
    /// When the datagram was made, in server time as the sender knows it.
    pub generated: ServerTime,
    /// The newest number that arrived from the other side.
    pub newest: u32,
    /// Bit i: number `newest` - 1 - i arrived.
    pub bits: u32,
}

/// What a datagram says.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// Where tools were.
    Motion(Vec<ToolTrack>),
    /// Where nodes of the tissue are.
    Corrections(Corrections),
    /// A question for the clock.
    Probe(Probe),
    /// Its answer.
    Reply(Reply),
    /// What each participant needs of the artificial delay.
    Delays(Vec<(ParticipantId, DelayReport)>),
}

/// A client asks for the server's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Probe {
    /// Counts the probes.
    pub id: u32,
    /// When it was sent, on the client's clock.
    pub client_sent: ClientTime,
}

/// The server answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply {
    /// Which probe.
    pub id: u32,
    /// The time in the probe.
    pub client_sent: ClientTime,
    /// When the probe arrived.
    pub server_received: ServerTime,
    /// When this was sent.
    pub server_sent: ServerTime,
}

const KIND_MOTION: u8 = 1;
const KIND_CORRECTIONS: u8 = 2;
const KIND_PROBE: u8 = 3;
const KIND_REPLY: u8 = 4;
const KIND_DELAYS: u8 = 5;

/// A header and what it heads.
#[derive(Debug, Clone, PartialEq)]
pub struct Datagram {
    /// The header.
    pub header: Header,
    /// The content.
    pub body: Body,
}

impl Datagram {
    /// The bytes on the wire; an error where a value is out of range or the whole is longer than
    /// [`DATAGRAM_MAX_BYTES`].
    pub fn encode(&self) -> Result<Vec<u8>, ProtocolError> {
        let mut w = Writer::with_capacity(DATAGRAM_MAX_BYTES);
        w.u8(match &self.body {
            Body::Motion(_) => KIND_MOTION,
            Body::Corrections(_) => KIND_CORRECTIONS,
            Body::Probe(_) => KIND_PROBE,
            Body::Reply(_) => KIND_REPLY,
            Body::Delays(_) => KIND_DELAYS,
        });
        self.header.write(&mut w);
        match &self.body {
            Body::Motion(tracks) => motion::write(&mut w, self.header.generated, tracks)?,
            Body::Corrections(c) => corrections::write(&mut w, self.header.generated, c)?,
            Body::Probe(p) => {
                w.u32(p.id);
                w.i64(p.client_sent.as_micros());
            }
            Body::Reply(r) => {
                w.u32(r.id);
                w.i64(r.client_sent.as_micros());
                w.i64(r.server_received.as_micros());
                w.i64(r.server_sent.as_micros());
            }
            Body::Delays(list) => write_delays(&mut w, list)?,
        }
        let out = w.into_vec();
        if out.len() > DATAGRAM_MAX_BYTES {
            return Err(ProtocolError::TooLarge {
                what: "datagram",
                bytes: out.len(),
                limit: DATAGRAM_MAX_BYTES,
            });
        }
        Ok(out)
    }

    /// Reads one datagram, all of it.
    pub fn decode(bytes: &[u8]) -> Result<Self, ProtocolError> {
        if bytes.len() > DATAGRAM_MAX_BYTES {
            return Err(ProtocolError::TooLarge {
                what: "datagram",
                bytes: bytes.len(),
                limit: DATAGRAM_MAX_BYTES,
            });
        }
        let mut r = Reader::new(bytes, "header");
        let kind = r.u8()?;
        let header = Header::read(&mut r)?;
        let body = match kind {
            KIND_MOTION => Body::Motion(motion::read(&mut r, header.generated)?),
            KIND_CORRECTIONS => Body::Corrections(corrections::read(&mut r, header.generated)?),
            KIND_PROBE => {
                r.part("probe");
                Body::Probe(Probe {
                    id: r.u32()?,
                    client_sent: ClientTime::from_micros(r.i64()?),
                })
            }
            KIND_REPLY => {
                r.part("reply");
                Body::Reply(Reply {
                    id: r.u32()?,
                    client_sent: ClientTime::from_micros(r.i64()?),
                    server_received: ServerTime::from_micros(r.i64()?),
                    server_sent: ServerTime::from_micros(r.i64()?),
                })
            }
            KIND_DELAYS => Body::Delays(read_delays(&mut r)?),
            kind => return Err(ProtocolError::DatagramKind { kind }),
        };
        r.finish()?;
        Ok(Self { header, body })
    }
}

impl Header {
    fn write(&self, w: &mut Writer) {
        w.u32(self.epoch.0);
        w.u16(self.stream.0);
        w.u32(self.sequence);
        w.i64(self.generated.as_micros());
        w.u32(self.newest);
        w.u32(self.bits);
    }

    fn read(r: &mut Reader<'_>) -> Result<Self, ProtocolError> {
        Ok(Self {
            epoch: Epoch(r.u32()?),
            stream: ParticipantId(r.u16()?),
            sequence: r.u32()?,
            generated: ServerTime::from_micros(r.i64()?),
            newest: r.u32()?,
            bits: r.u32()?,
        })
    }
}

fn write_delays(
    w: &mut Writer,
    list: &[(ParticipantId, DelayReport)],
) -> Result<(), ProtocolError> {
    if list.len() > DELAYS_MAX {
        return Err(ProtocolError::TooLarge {
            what: "delays",
            bytes: list.len(),
            limit: DELAYS_MAX,
        });
    }
    w.u8(list.len() as u8);
    for (participant, d) in list {
        w.u16(participant.0);
        w.u32(d.mean_us);
        w.u32(d.deviation_us);
        w.u32(d.wanted_us);
    }
    Ok(())
}

fn read_delays(r: &mut Reader<'_>) -> Result<Vec<(ParticipantId, DelayReport)>, ProtocolError> {
    r.part("delays");
    let count = usize::from(r.u8()?);
    if count > DELAYS_MAX {
        return Err(ProtocolError::OutOfRange {
            what: "the number of delay reports",
            detail: format!("{count}, at most {DELAYS_MAX}"),
        });
    }
    r.expect_items(count, 14)?;
    (0..count)
        .map(|_| {
            let participant = ParticipantId(r.u16()?);
            let report = DelayReport {
                mean_us: r.u32()?,
                deviation_us: r.u32()?,
                wanted_us: r.u32()?,
            };
            Ok((participant, report))
        })
        .collect()
}

#[cfg(test)]
mod tests;
