//! Collects the fixed bytes at the beginning of a stream, from pieces of any size.

use crate::ProtocolError;
use crate::handshake::{PREAMBLE_BYTES, PREAMBLE_SENTENCE_MAX_BYTES, Preamble};

/// The beginning of a stream, as far as it has arrived.
#[derive(Debug, Default)]
pub(super) struct PreambleReader {
    bytes: Vec<u8>,
}

/// A complete preamble, and the number of the last bytes given that belong to the data after it.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Opening {
    pub(super) preamble: Preamble,
    /// The sentence of a server that refuses.
    pub(super) sentence: Option<String>,
    pub(super) left_over: usize,
}

impl PreambleReader {
    /// Takes received bytes; `None` while more are needed. Keeps at most the preamble with its longest
    /// sentence.
    pub(super) fn push(&mut self, bytes: &[u8]) -> Result<Option<Opening>, ProtocolError> {
        const WHOLE_MAX: usize = PREAMBLE_BYTES + 2 + PREAMBLE_SENTENCE_MAX_BYTES;
        let before = self.bytes.len();
        let take = bytes.len().min(WHOLE_MAX - before);
        self.bytes.extend_from_slice(&bytes[..take]);
        let Some((head, rest)) = self.bytes.split_first_chunk::<PREAMBLE_BYTES>() else {
            return Ok(None);
        };
        let preamble = Preamble::from_bytes(*head)?;
        let (sentence, used) = if preamble.status == 0 {
            (None, PREAMBLE_BYTES)
        } else {
            let Some((len, text)) = rest.split_first_chunk::<2>() else {
                return Ok(None);
            };
            let len = usize::from(u16::from_le_bytes(*len));
            if len > PREAMBLE_SENTENCE_MAX_BYTES {
                return Err(ProtocolError::FrameTooLong {
                    bytes: len as u64,
                    limit: PREAMBLE_SENTENCE_MAX_BYTES,
                });
            }
            let Some(text) = text.get(..len) else {
                return Ok(None);
            };
            let clean = String::from_utf8_lossy(text).replace(char::is_control, " ");
            (Some(clean), PREAMBLE_BYTES + 2 + len)
        };
        Ok(Some(Opening {
            preamble,
            sentence,
            left_over: before + bytes.len() - used,
        }))
    }
}

/// A server's preamble that refuses, with its sentence.
pub(super) fn refusing(sentence: &str) -> Vec<u8> {
    let mut end = sentence.len().min(PREAMBLE_SENTENCE_MAX_BYTES);
    while !sentence.is_char_boundary(end) {
        end -= 1;
    }
    let mut out = Preamble {
        status: 1,
        ..Preamble::OURS
    }
    .to_bytes()
    .to_vec();
    out.extend_from_slice(&(end as u16).to_le_bytes());
    out.extend_from_slice(&sentence.as_bytes()[..end]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preamble_is_read_from_any_pieces() {
        let mut whole = refusing("no");
        whole.extend_from_slice(b"rest");
        for piece in 1..=whole.len() {
            let mut reader = PreambleReader::default();
            let mut fed = 0;
            let opening = whole.chunks(piece).find_map(|c| {
                fed += c.len();
                reader.push(c).unwrap()
            });
            let opening = opening.unwrap();
            assert_eq!(opening.sentence.as_deref(), Some("no"));
            assert_eq!(&whole[fed - opening.left_over..fed][..], &whole[12..fed]);
        }
    }

    #[test]
    fn another_program_is_recognised() {
        let error = PreambleReader::default().push(b"HTTP/1.1 400").unwrap_err();
        assert!(error.to_string().contains("does not speak palpate"));
    }
}
