//! Frames of a page over WebTransport: texts and surfaces on one stream, tools as datagrams, each shape on a stream of
//! its own.

use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::ws::Utf8Bytes;
use palpate_protocol::Span;
use palpate_transport::{Delivery, PageBytes, PageReceiver, PageSender};

use crate::connection::{BINARY_BYTES_MAX, FrameFate, Heard, TEXT_BYTES_MAX};
use crate::shape_streams::ShapeStreams;
use crate::{shape_code, tool_code};

/// Bytes before a frame on the stream: its length (u32) and its type.
const HEAD_BYTES: usize = 5;

/// Bytes that a page must take within [`PART_MAX`], or it is closed.
const PART_BYTES: usize = 64 * 1024;
const PART_MAX: Duration = Duration::from_secs(10);

/// Types of frames.
const TEXT: u8 = 0;
const BINARY: u8 = 1;

/// The half that receives.
pub(crate) struct FrameReceiver {
    receiver: PageReceiver,
    /// Bytes of the stream that are not read yet: less than two frames.
    arrived: Vec<u8>,
}

impl FrameReceiver {
    /// The next frame of the page. No frame is lost if the wait is given up.
    pub(crate) async fn receive(&mut self) -> Heard {
        loop {
            if let Some(heard) = take_frame(&mut self.arrived) {
                return heard;
            }
            match self.receiver.receive().await {
                Some(PageBytes::Stream(bytes)) => self.arrived.extend_from_slice(&bytes),
                Some(PageBytes::Datagram(bytes)) => return Heard::Binary(bytes.into()),
                None => return Heard::Gone,
            }
        }
    }

    /// The round trip, smoothed.
    pub(crate) fn round_trip(&self) -> Span {
        Span::from_micros(self.receiver.round_trip().as_micros() as i64)
    }
}

/// The half that sends.
pub(crate) struct FrameSender {
    sender: PageSender,
    shapes: ShapeStreams<Delivery>,
}

/// Both halves of a session.
pub(crate) fn frames(
    (sender, receiver): (PageSender, PageReceiver),
) -> (FrameSender, FrameReceiver) {
    let sender = FrameSender {
        sender,
        shapes: ShapeStreams::default(),
    };
    let receiver = FrameReceiver {
        receiver,
        arrived: Vec::new(),
    };
    (sender, receiver)
}

impl FrameSender {
    pub(crate) async fn send_text(&mut self, text: &str) -> bool {
        self.send(TEXT, text.as_bytes()).await
    }

    pub(crate) async fn send_binary(&mut self, bytes: &[u8]) -> bool {
        self.send(BINARY, bytes).await
    }

    async fn send(&mut self, kind: u8, bytes: &[u8]) -> bool {
        let mut head = [0; HEAD_BYTES];
        head[..4].copy_from_slice(&(bytes.len() as u32).to_le_bytes());
        head[4] = kind;
        for part in [&head[..]].into_iter().chain(bytes.chunks(PART_BYTES)) {
            let sent = tokio::time::timeout(PART_MAX, self.sender.send(part)).await;
            if sent != Ok(true) {
                return false;
            }
        }
        true
    }

    /// Sends a frame that the next one replaces.
    pub(crate) async fn send_frame(&mut self, frame: Bytes) -> FrameFate {
        match frame.first() {
            Some(&tool_code::KIND) if frame.len() <= self.sender.datagram_max() => {
                self.sender.send_datagram(&frame);
                FrameFate::Sent
            }
            Some(&shape_code::KIND) => {
                let now = Instant::now();
                let is_full = shape_code::is_full(&frame);
                let round_trip = self.sender.round_trip();
                if !self.shapes.make_room(is_full, now, round_trip) {
                    return FrameFate::Dropped;
                }
                let sent = self.sender.send_apart(frame);
                self.shapes.add(is_full, now, sent);
                FrameFate::Sent
            }
            _ if self.send_binary(&frame).await => FrameFate::Sent,
            _ => FrameFate::Gone,
        }
    }

    /// The page has said hello; the session decides.
    pub(crate) fn handle_hello(&self) {
        self.sender.handle_hello();
    }

    /// The page takes part.
    pub(crate) fn admit(&mut self) {
        self.sender.admit();
    }

    /// Ends the stream, and waits until the page has what was sent.
    pub(crate) async fn finish(&mut self) {
        self.sender.finish().await;
    }

    /// Closes the session.
    pub(crate) async fn close(self, code: u16, sentence: &str) {
        self.sender.close(u32::from(code), sentence).await;
    }
}

/// Takes a frame off the front of the bytes of the stream, if it is complete.
fn take_frame(arrived: &mut Vec<u8>) -> Option<Heard> {
    let head = arrived.first_chunk::<HEAD_BYTES>()?;
    let [a, b, c, d, kind] = *head;
    let len = u32::from_le_bytes([a, b, c, d]) as usize;
    let (name, max) = match kind {
        TEXT => ("text", TEXT_BYTES_MAX),
        BINARY => ("binary", BINARY_BYTES_MAX),
        other => return Some(Heard::Violation(format!("a frame of unknown type {other}"))),
    };
    if len > max {
        return Some(Heard::Violation(format!(
            "a {name} message of more than {max} bytes"
        )));
    }
    let end = HEAD_BYTES + len;
    let content = arrived.get(HEAD_BYTES..end)?.to_vec();
    arrived.drain(..end);
    if kind == BINARY {
        return Some(Heard::Binary(content.into()));
    }
    Some(match String::from_utf8(content) {
        Ok(text) => Heard::Text(Utf8Bytes::from(text)),
        Err(_) => Heard::Violation("a text that is not UTF-8".to_owned()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(kind: u8, content: &[u8]) -> Vec<u8> {
        let mut bytes = (content.len() as u32).to_le_bytes().to_vec();
        bytes.push(kind);
        bytes.extend_from_slice(content);
        bytes
    }

    #[test]
    fn frames_are_equal_however_the_stream_is_split() {
        let mut stream = frame(TEXT, b"{}");
        stream.extend(frame(BINARY, &[16, 1]));
        stream.extend(frame(TEXT, b""));
        for size in 1..=stream.len() {
            let mut arrived = Vec::new();
            let mut frames = Vec::new();
            for part in stream.chunks(size) {
                arrived.extend_from_slice(part);
                while let Some(heard) = take_frame(&mut arrived) {
                    frames.push(match heard {
                        Heard::Text(text) => format!("text {text}"),
                        Heard::Binary(bytes) => format!("binary {bytes:?}"),
                        _ => panic!("another frame"),
                    });
                }
            }
            assert!(arrived.is_empty());
            assert_eq!(frames, ["text {}", r#"binary b"\x10\x01""#, "text "]);
        }
    }

    #[test]
    fn violations_are_found_before_their_content_arrives() {
        for (head, part) in [
            (frame(TEXT, &vec![b' '; TEXT_BYTES_MAX + 1]), "text message"),
            (frame(BINARY, &vec![0; BINARY_BYTES_MAX + 1]), "2048 bytes"),
            (frame(7, b""), "unknown type 7"),
        ] {
            let mut arrived = head[..HEAD_BYTES].to_vec();
            let Some(Heard::Violation(sentence)) = take_frame(&mut arrived) else {
                panic!("{part} was accepted");
            };
            assert!(sentence.contains(part), "{sentence}");
        }
        let mut arrived = frame(TEXT, &[0xff]);
        assert!(matches!(
            take_frame(&mut arrived),
            Some(Heard::Violation(_))
        ));
    }
}
