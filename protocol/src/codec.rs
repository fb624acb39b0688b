//! Messages of the operations stream as bytes: length-prefixed frames around bincode. The only
//! file that uses bincode.

use std::marker::PhantomData;

use bincode::config;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::ProtocolError;
use crate::request::{ClientMessage, ServerMessage};

/// The largest frame after the handshake in bytes. It holds the longest stroke twice.
pub const FRAME_MAX_BYTES: usize = 64 * 1024;

/// The largest frame before the hello is accepted, bytes: a hello has at most some hundred.
pub const HELLO_MAX_BYTES: usize = 4 * 1024;

/// Bytes of the length prefix of a frame (u32, little endian).
pub const PREFIX_BYTES: usize = 4;

/// bincode counts the size that it claims before it reads, so that the last small number of a full frame
/// needs a few bytes beyond the frame.
const DECODE_LIMIT: usize = FRAME_MAX_BYTES + 64;

/// A message that travels in frames.
pub trait Message: Serialize + DeserializeOwned {
    /// Its name in errors.
    const NAME: &'static str;
}

impl Message for ClientMessage {
    const NAME: &'static str = "client message";
}

impl Message for ServerMessage {
    const NAME: &'static str = "server message";
}

/// One frame: the length prefix and the message.
pub fn encode_frame<M: Message>(message: &M) -> Result<Vec<u8>, ProtocolError> {
    let mut out = vec![0; PREFIX_BYTES];
    let too_large = |bytes| ProtocolError::TooLarge {
        what: M::NAME,
        bytes,
        limit: FRAME_MAX_BYTES,
    };
    let body =
        bincode::serde::encode_to_vec(message, config::standard()).map_err(|_| too_large(0))?;
    if body.len() > FRAME_MAX_BYTES {
        return Err(too_large(body.len()));
    }
    out[..PREFIX_BYTES].copy_from_slice(&(body.len() as u32).to_le_bytes());
    out.extend_from_slice(&body);
    Ok(out)
}

/// Reads the body of one frame, all of it.
pub fn decode_body<M: Message>(body: &[u8]) -> Result<M, ProtocolError> {
    let bad = |detail: String| ProtocolError::BadFrame {
        what: M::NAME,
        bytes: body.len(),
        detail,
    };
    let (message, used) =
        bincode::serde::decode_from_slice(body, config::standard().with_limit::<DECODE_LIMIT>())
            .map_err(|e| bad(e.to_string()))?;
    if used != body.len() {
        return Err(ProtocolError::TrailingBytes {
            what: M::NAME,
            extra: body.len() - used,
        });
    }
    Ok(message)
}

/// Reassembles frames from a stream that arrives in arbitrary pieces.
///
/// Call [`push`](Self::push) with the received bytes, then [`next`](Self::next) until it returns `None`.
/// After an error the decoder can not be used: the session closes. It holds at most one frame of the
/// limit plus the largest piece pushed, provided that it is drained after each push.
#[derive(Debug)]
pub struct FrameDecoder<M> {
    buffer: Vec<u8>,
    read: usize,
    limit: usize,
    message: PhantomData<fn() -> M>,
}

impl<M: Message> FrameDecoder<M> {
    /// A decoder that refuses frames longer than `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self {
            buffer: Vec::new(),
            read: 0,
            limit: limit.min(FRAME_MAX_BYTES),
            message: PhantomData,
        }
    }

    /// Allows frames up to `limit` bytes from now on.
    pub fn set_limit(&mut self, limit: usize) {
        self.limit = limit.min(FRAME_MAX_BYTES);
    }

    /// Appends received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        if self.read > 0 {
            self.buffer.drain(..self.read);
            self.read = 0;
        }
        self.buffer.extend_from_slice(bytes);
    }

    /// The next whole message, if it is there.
    #[expect(
        clippy::should_implement_trait,
        reason = "an iterator can not end and then go on"
    )]
    pub fn next(&mut self) -> Result<Option<M>, ProtocolError> {
        let rest = &self.buffer[self.read..];
        let Some((prefix, rest)) = rest.split_first_chunk::<PREFIX_BYTES>() else {
            return Ok(None);
        };
        let len = u32::from_le_bytes(*prefix) as usize;
        if len > self.limit {
            return Err(ProtocolError::FrameTooLong {
                bytes: len as u64,
                limit: self.limit,
            });
        }
        let Some(body) = rest.get(..len) else {
            return Ok(None);
        };
        let message = decode_body(body)?;
        self.read += PREFIX_BYTES + len;
        Ok(Some(message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::operation::{BladePoint, STROKE_MAX_POINTS};
    use crate::request::{CutRequest, Request, RequestKind, TimedBladePoint};
    use crate::{RequestId, ServerTime};
    use proptest::prelude::*;

    fn longest_request() -> ClientMessage {
        let blade = BladePoint {
            tip_m: [1.5, -2.5, 3.5],
            axis: [0.0, 0.0, 1.0],
            depth_m: 0.125,
        };
        let time = ServerTime::from_micros(i64::MAX / 2);
        let points = vec![TimedBladePoint { time, blade }; STROKE_MAX_POINTS];
        let kind = RequestKind::Cut(CutRequest::whole(points, 0.001));
        ClientMessage::Request(Request {
            id: RequestId(9),
            kind,
        })
    }

    fn leave() -> ClientMessage {
        ClientMessage::Request(Request {
            id: RequestId(1),
            kind: RequestKind::Leave,
        })
    }

    #[test]
    fn the_longest_stroke_fits_into_half_a_frame() {
        let frame = encode_frame(&longest_request()).unwrap();
        assert!(
            frame.len() < FRAME_MAX_BYTES * 2 / 3,
            "{} bytes",
            frame.len()
        );
        assert_eq!(
            decode_body::<ClientMessage>(&frame[PREFIX_BYTES..]),
            Ok(longest_request())
        );
    }

    #[test]
    fn frame_with_excessive_length_is_rejected_before_it_arrives() {
        let mut decoder = FrameDecoder::<ClientMessage>::new(HELLO_MAX_BYTES);
        decoder.push(&(HELLO_MAX_BYTES as u32 + 1).to_le_bytes());
        let error = decoder.next().unwrap_err();
        assert!(
            matches!(error, ProtocolError::FrameTooLong { .. }),
            "{error}"
        );
    }

    #[test]
    fn list_with_excessive_length_is_rejected() {
        // A cut request whose list has 2^60 points.
        let mut body = encode_frame(&longest_request())
            .unwrap()
            .split_off(PREFIX_BYTES);
        body.truncate(3);
        body.push(253);
        body.extend_from_slice(&(1_u64 << 60).to_le_bytes());
        assert!(decode_body::<ClientMessage>(&body).is_err());
    }

    #[test]
    fn bytes_after_a_message_are_an_error() {
        let mut body = encode_frame(&leave()).unwrap().split_off(PREFIX_BYTES);
        body.push(0);
        let error = decode_body::<ClientMessage>(&body).unwrap_err();
        assert!(
            matches!(error, ProtocolError::TrailingBytes { extra: 1, .. }),
            "{error}"
        );
    }

    proptest! {
        #[test]
        fn frames_come_whole_out_of_any_pieces(cuts in proptest::collection::vec(1_usize..3000, 1..40)) {
            let sent = [leave(), longest_request(), leave(), leave()];
            let bytes: Vec<u8> = sent.iter().flat_map(|m| encode_frame(m).unwrap()).collect();
            let mut decoder = FrameDecoder::<ClientMessage>::new(FRAME_MAX_BYTES);
            let (mut got, mut at, mut i) = (Vec::new(), 0, 0);
            while at < bytes.len() {
                let end = (at + cuts[i % cuts.len()]).min(bytes.len());
                decoder.push(&bytes[at..end]);
                while let Some(message) = decoder.next().unwrap() {
                    got.push(message);
                }
                (at, i) = (end, i + 1);
            }
            prop_assert_eq!(&got[..], &sent[..]);
        }

        #[test]
        fn no_noise_makes_the_decoder_panic(body in proptest::collection::vec(any::<u8>(), 0..600)) {
            let _ = decode_body::<ClientMessage>(&body);
            let _ = decode_body::<ServerMessage>(&body);
        }
    }
}
