//! Unreliable messages: datagrams of at most [`DATAGRAM_MAX_BYTES`], packed by hand.
//!
//! All integers are little endian. Every datagram begins with the header
//!
//! ```text
//! first u8 | second u8 | sequence, low 8 bits | time | newest u16, bits u32
//! ```
//!
//! First byte: bits 0 to 2 are the kind, bit 3 marks an acknowledgement, bit 4 a whole number and time,
//! bits 5 to 7 are the low bits of the session's epoch. Second byte: bits 0 to 3 are the low bits of the
//! participant whose connection it is, in both directions; bits 4 to 7 are bits 8 to 11 of the sequence,
//! which counts the datagrams of one direction. Time: sequence u32 and time i64 if they are whole.
//! Otherwise motion has none, because its body contains it, and other kinds have the low 16 bits of the
//! time; in steps of 50 µs. `newest` (low 16 bits) and `bits` acknowledge the other direction: bit i
//! acknowledges number `newest` - 1 - i. The receiver completes truncated values to those nearest to the
//! newest that arrived. The body follows:
//!
//! | kind | body |
//! | --- | --- |
//! | 1 motion | tracks, see [`motion`] |
//! | 2 corrections | displacements of chosen nodes, see [`shape`] |
//! | 3 probe | id u32, client time i64 |
//! | 4 reply | id u32, client time i64, server received i64, server sent i64 |
//! | 5 delays | count u8, then {participant u16, mean u32, deviation u32, wanted u32} |
//! | 6 displacements | those of all nodes in view, see [`shape`] |
//! | 7 copy | number on the operations stream u32, a message of it as in its frame |
//!
//! Decoders never panic, never allocate more than the datagram could hold, and reject trailing bytes.

mod bytes;
mod corrections;
mod header;
mod late;
pub mod memory;
pub mod motion;
mod quantise;
mod range_coder;
pub mod shape;

use bytes::{Reader, Writer};

use range_coder::{RangeDecoder, RangeEncoder};
use shape::{Frame, Nodes};

pub use corrections::{Corrections, Displacements};
pub use header::{Acknowledgement, Expected, Header, SHORT_SEQUENCE, SHORT_TIME, Tag};
pub use memory::Memory;
pub use quantise::{POSITION_MAX_M, POSITION_STEP_M, TIME_STEP_US, as_sent};

use crate::request::DelayReport;
use crate::session::MessageCopy;
use crate::{ClientTime, ParticipantId, ProtocolError, ServerTime, ToolTrack};

/// The largest datagram in bytes: below the smallest path that QUIC allows (1200 B of UDP payload) with
/// room for its own header. The rest of a message goes into the next datagram.
pub const DATAGRAM_MAX_BYTES: usize = 1100;

/// The most samples of one tool in one datagram: the newest batch of four 1 kHz samples and the
/// batch before, repeated.
pub const TRACK_MAX_SAMPLES: usize = 8;

/// The most tools in one datagram; a datagram that names more is refused.
pub const TRACKS_MAX: usize = 64;

/// The most delay reports in one datagram.
pub const DELAYS_MAX: usize = 64;

/// The content of a datagram.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// Tool samples.
    Motion(Vec<ToolTrack>),
    /// Displacements of some nodes of the tissue.
    Corrections(Corrections),
    /// Displacements of all nodes in view.
    Displacements(Displacements),
    /// A clock probe.
    Probe(Probe),
    /// The answer to a clock probe.
    Reply(Reply),
    /// Each participant's delay estimate.
    Delays(Vec<(ParticipantId, DelayReport)>),
    /// A stream message once more, in case its packet is lost.
    Copy(MessageCopy),
}

/// A client's query of the server's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Probe {
    /// Counts the probes.
    pub id: u32,
    /// When it was sent, on the client's clock.
    pub client_sent: ClientTime,
}

/// The server's answer to a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply {
    /// The number of the probe.
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
const KIND_DISPLACEMENTS: u8 = 6;
const KIND_COPY: u8 = 7;

/// The number and time of the datagram, to which a body may refer.
#[derive(Debug, Clone, Copy)]
struct Moment {
    sequence: u32,
    stream: ParticipantId,
    generated: ServerTime,
    is_whole: bool,
}

/// A header with its body.
#[derive(Debug, Clone, PartialEq)]
pub struct Datagram {
    /// The header.
    pub header: Header,
    /// The content.
    pub body: Body,
}

impl Body {
    const fn kind(&self) -> u8 {
        match self {
            Self::Motion(_) => KIND_MOTION,
            Self::Corrections(_) => KIND_CORRECTIONS,
            Self::Probe(_) => KIND_PROBE,
            Self::Reply(_) => KIND_REPLY,
            Self::Delays(_) => KIND_DELAYS,
            Self::Displacements(_) => KIND_DISPLACEMENTS,
            Self::Copy(_) => KIND_COPY,
        }
    }

    /// Two halves of a body that is too large for one datagram; `None` for an indivisible one.
    pub(crate) fn halves(self) -> Option<(Self, Self)> {
        match self {
            Self::Motion(mut tracks) if tracks.len() > 1 => {
                let rest = tracks.split_off(tracks.len() / 2);
                Some((Self::Motion(tracks), Self::Motion(rest)))
            }
            Self::Corrections(mut c) if c.nodes.len() > 1 => {
                let nodes = c.nodes.split_off(c.nodes.len() / 2);
                let rest = Corrections { nodes, ..c };
                Some((Self::Corrections(c), Self::Corrections(rest)))
            }
            Self::Displacements(mut d) if d.nodes.len() > 1 => {
                let nodes = d.nodes.split_off(d.nodes.len() / 2);
                let rest = Displacements { nodes, ..d };
                Some((Self::Displacements(d), Self::Displacements(rest)))
            }
            _ => None,
        }
    }
}

impl Datagram {
    /// The bytes on the wire; an error where a value is out of range or the whole is longer than
    /// [`DATAGRAM_MAX_BYTES`]. `memory` is of this direction: it provides the baseline and stores the
    /// content of this datagram.
    pub fn encode(&self, memory: &mut Memory) -> Result<Vec<u8>, ProtocolError> {
        let bytes = self.encode_any_size(memory).and_then(|out| {
            if out.len() > DATAGRAM_MAX_BYTES {
                return Err(ProtocolError::TooLarge {
                    what: "datagram",
                    bytes: out.len(),
                    limit: DATAGRAM_MAX_BYTES,
                });
            }
            Ok(out)
        });
        if bytes.is_err() {
            memory.forget(self.header.sequence);
        }
        bytes
    }

    fn encode_any_size(&self, memory: &mut Memory) -> Result<Vec<u8>, ProtocolError> {
        let mut w = Writer::with_capacity(DATAGRAM_MAX_BYTES);
        self.header.write(self.body.kind(), &mut w);
        let at = self.header.moment();
        Ok(match &self.body {
            Body::Motion(tracks) => {
                let mut c = RangeEncoder::after(w.into_vec());
                motion::write(&mut c, at, memory, tracks)?;
                c.finish()
            }
            Body::Corrections(x) => {
                let frame = Frame {
                    topology_version: x.topology_version,
                    view_time: x.view_time,
                    waiting: 0,
                };
                let nodes = Nodes::of(shape::FINE_STEP_UM, &x.nodes);
                let mut c = RangeEncoder::after(w.into_vec());
                shape::write(&mut c, at, memory, frame, nodes)?;
                c.finish()
            }
            Body::Displacements(x) => {
                let frame = Frame {
                    topology_version: x.topology_version,
                    view_time: x.view_time,
                    waiting: x.waiting,
                };
                let nodes = Nodes::of(x.step_um, &x.nodes);
                let mut c = RangeEncoder::after(w.into_vec());
                shape::write(&mut c, at, memory, frame, nodes)?;
                c.finish()
            }
            Body::Probe(p) => {
                w.u32(p.id);
                w.i64(p.client_sent.as_micros());
                w.into_vec()
            }
            Body::Reply(r) => {
                w.u32(r.id);
                w.i64(r.client_sent.as_micros());
                w.i64(r.server_received.as_micros());
                w.i64(r.server_sent.as_micros());
                w.into_vec()
            }
            Body::Delays(list) => {
                write_delays(&mut w, list)?;
                w.into_vec()
            }
            Body::Copy((number, message)) => {
                w.u32(*number);
                let mut out = w.into_vec();
                out.extend_from_slice(message);
                out
            }
        })
    }

    /// Reads exactly one datagram. `expected` completes truncated header fields; `memory` is of this
    /// direction.
    pub fn decode(
        bytes: &[u8],
        expected: &Expected,
        memory: &mut Memory,
    ) -> Result<Self, ProtocolError> {
        let opened = Opened::read(bytes, expected)?;
        opened.body(memory)
    }
}

/// A datagram of which only the header is read.
#[derive(Debug, Clone, Copy)]
pub struct Opened<'a> {
    /// The header.
    pub header: Header,
    kind: u8,
    rest: &'a [u8],
}

impl<'a> Opened<'a> {
    /// Reads the header.
    pub fn read(bytes: &'a [u8], expected: &Expected) -> Result<Self, ProtocolError> {
        if bytes.len() > DATAGRAM_MAX_BYTES {
            return Err(ProtocolError::TooLarge {
                what: "datagram",
                bytes: bytes.len(),
                limit: DATAGRAM_MAX_BYTES,
            });
        }
        let mut r = Reader::new(bytes, "header");
        let (header, kind) = Header::read(&mut r, expected)?;
        Ok(Self {
            header,
            kind,
            rest: r.rest(),
        })
    }

    /// Reads the body too.
    pub fn body(self, memory: &mut Memory) -> Result<Datagram, ProtocolError> {
        let datagram = self.read_body(memory);
        if datagram.is_err() {
            memory.forget(self.header.sequence);
        }
        datagram
    }

    fn read_body(mut self, memory: &mut Memory) -> Result<Datagram, ProtocolError> {
        let at = self.header.moment();
        let body = match self.kind {
            KIND_MOTION => {
                let mut c = RangeDecoder::new(self.rest, "motion");
                let tracks = motion::read(&mut c, at, memory)?;
                c.finish()?;
                let newest = tracks.first().and_then(|t| t.samples.last());
                self.header.generated = newest.map_or(self.header.generated, |s| s.time);
                Body::Motion(tracks)
            }
            KIND_CORRECTIONS => {
                let mut c = RangeDecoder::new(self.rest, "corrections");
                let (frame, nodes) = shape::read(&mut c, at, memory)?;
                c.finish()?;
                if nodes.step_um != shape::FINE_STEP_UM {
                    return Err(ProtocolError::OutOfRange {
                        what: "the step of corrections",
                        detail: format!("{} µm", nodes.step_um),
                    });
                }
                Body::Corrections(Corrections {
                    topology_version: frame.topology_version,
                    view_time: frame.view_time,
                    nodes: nodes.metres(),
                })
            }
            KIND_DISPLACEMENTS => {
                let mut c = RangeDecoder::new(self.rest, "displacements");
                let (frame, nodes) = shape::read(&mut c, at, memory)?;
                c.finish()?;
                Body::Displacements(Displacements {
                    step_um: nodes.step_um,
                    waiting: frame.waiting,
                    topology_version: frame.topology_version,
                    view_time: frame.view_time,
                    nodes: nodes.metres(),
                })
            }
            KIND_COPY => {
                let mut r = Reader::new(self.rest, "copy");
                Body::Copy((r.u32()?, r.rest().to_vec()))
            }
            kind => read_plain(kind, self.rest)?,
        };
        Ok(Datagram {
            header: self.header,
            body,
        })
    }
}

/// The bodies of whole bytes.
fn read_plain(kind: u8, bytes: &[u8]) -> Result<Body, ProtocolError> {
    let mut r = Reader::new(bytes, "probe");
    let body = match kind {
        KIND_PROBE => Body::Probe(Probe {
            id: r.u32()?,
            client_sent: ClientTime::from_micros(r.i64()?),
        }),
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
    Ok(body)
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
