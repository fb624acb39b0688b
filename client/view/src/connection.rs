//! The connection of a page: a WebSocket or a WebTransport session, with the same frames and limits.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt as _, StreamExt as _};
use palpate_protocol::Span;
use palpate_transport::{PageReceiver, PageSender};

use crate::page::Reliable;
use crate::web_transport::{self, FrameReceiver, FrameSender};

/// Maximum size of a text message and of a binary one, bytes.
pub(crate) const TEXT_BYTES_MAX: usize = 16 * 1024;
pub(crate) const BINARY_BYTES_MAX: usize = 2 * 1024;

/// Longest time to send one message: a surface of a few megabytes over a slow network.
const SEND_MAX: Duration = Duration::from_secs(60);

/// Longest wait for a page's answer to a close.
const CLOSE_MAX: Duration = Duration::from_secs(1);

/// Code of a close for a violation of the format (RFC 6455, 7.4.1).
pub(crate) const POLICY: u16 = 1008;
/// Code of any other close by the host.
pub(crate) const GOING_AWAY: u16 = 1001;

/// A message of a page.
pub(crate) enum Heard {
    Text(Utf8Bytes),
    Binary(Bytes),
    /// The answer of a browser to a ping, with its content.
    Answer(Bytes),
    /// A message without meaning here.
    Other,
    /// A frame that is not allowed, with a sentence.
    Violation(String),
    Gone,
}

/// Fate of a frame that the next one replaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FrameFate {
    Sent,
    /// The page does not get it, or not the ones before it.
    Dropped,
    /// The page is gone.
    Gone,
}

/// The half of a connection that receives.
pub(crate) enum Incoming {
    WebSocket(SplitStream<WebSocket>),
    WebTransport(Box<FrameReceiver>),
}

/// The half of a connection that sends.
pub(crate) enum Outgoing {
    WebSocket(SplitSink<WebSocket, Message>),
    WebTransport(Box<FrameSender>),
}

/// Both halves of a connection.
pub(crate) type Halves = (Outgoing, Incoming);

/// The halves of a WebSocket.
pub(crate) fn web_socket(socket: WebSocket) -> Halves {
    let (sink, stream) = socket.split();
    (Outgoing::WebSocket(sink), Incoming::WebSocket(stream))
}

/// The halves of a WebTransport session.
pub(crate) fn web_transport(session: (PageSender, PageReceiver)) -> Halves {
    let (sender, receiver) = web_transport::frames(session);
    (
        Outgoing::WebTransport(Box::new(sender)),
        Incoming::WebTransport(Box::new(receiver)),
    )
}

impl Incoming {
    /// The next message. No message is lost if the wait is given up.
    pub(crate) async fn receive(&mut self) -> Heard {
        match self {
            Self::WebSocket(stream) => match stream.next().await {
                Some(Ok(Message::Text(text))) => Heard::Text(text),
                Some(Ok(Message::Binary(bytes))) if bytes.len() > BINARY_BYTES_MAX => {
                    Heard::Violation(format!(
                        "a binary message of more than {BINARY_BYTES_MAX} bytes"
                    ))
                }
                Some(Ok(Message::Binary(bytes))) => Heard::Binary(bytes),
                Some(Ok(Message::Pong(content))) => Heard::Answer(content),
                Some(Ok(Message::Ping(_))) => Heard::Other,
                Some(Ok(Message::Close(_)) | Err(_)) | None => Heard::Gone,
            },
            Self::WebTransport(receiver) => receiver.receive().await,
        }
    }

    /// The round trip, if the transport measures it. Otherwise [`Outgoing::ping`] does.
    pub(crate) fn round_trip(&self) -> Option<Span> {
        match self {
            Self::WebSocket(_) => None,
            Self::WebTransport(receiver) => Some(receiver.round_trip()),
        }
    }
}

impl Outgoing {
    /// Sends a message reliably and in order, except for a close. `false` when the page is gone or too slow.
    pub(crate) async fn send(&mut self, message: Reliable) -> bool {
        match (self, message) {
            (Self::WebSocket(sink), Reliable::Text(text) | Reliable::Welcome(text)) => {
                send_socket(sink, Message::Text(text)).await
            }
            (Self::WebSocket(sink), Reliable::Bytes(bytes)) => {
                send_socket(sink, Message::Binary(bytes)).await
            }
            (Self::WebTransport(sender), Reliable::Text(text)) => sender.send_text(&text).await,
            (Self::WebTransport(sender), Reliable::Welcome(text)) => {
                sender.admit();
                sender.send_text(&text).await
            }
            (Self::WebTransport(sender), Reliable::Bytes(bytes)) => {
                sender.send_binary(&bytes).await
            }
            (_, Reliable::Close(_)) => false,
        }
    }

    /// Sends a frame that the next one replaces.
    pub(crate) async fn send_frame(&mut self, frame: Bytes) -> FrameFate {
        match self {
            Self::WebSocket(sink) => {
                if send_socket(sink, Message::Binary(frame)).await {
                    FrameFate::Sent
                } else {
                    FrameFate::Gone
                }
            }
            Self::WebTransport(sender) => sender.send_frame(frame).await,
        }
    }

    /// Measures the round trip, unless the transport does. `stamp` comes back in [`Heard::Answer`].
    pub(crate) async fn ping(&mut self, stamp: u64) -> bool {
        match self {
            Self::WebSocket(sink) => {
                let content = Bytes::copy_from_slice(&stamp.to_le_bytes());
                send_socket(sink, Message::Ping(content)).await
            }
            Self::WebTransport(_) => true,
        }
    }

    /// The page has said hello; the session decides.
    pub(crate) fn handle_hello(&self) {
        if let Self::WebTransport(sender) = self {
            sender.handle_hello();
        }
    }

    /// Closes the connection with a sentence, which arrives after all messages.
    pub(crate) async fn close(self, mut incoming: Incoming, code: u16, sentence: &str) {
        // A WebSocket with unread bytes would be reset, and a WebTransport session drops what the page has not read: the
        // sentence would be lost. Pages close by themselves after a farewell.
        let drained = async { while !matches!(incoming.receive().await, Heard::Gone) {} };
        match self {
            Self::WebSocket(mut sink) => {
                let close = Message::Close(Some(close_frame(code, sentence)));
                if send_socket(&mut sink, close).await {
                    let _ = tokio::time::timeout(CLOSE_MAX, drained).await;
                }
            }
            Self::WebTransport(mut sender) => {
                sender.finish().await;
                if code == GOING_AWAY {
                    let _ = tokio::time::timeout(CLOSE_MAX, drained).await;
                }
                sender.close(code, sentence).await;
            }
        }
    }
}

async fn send_socket(sink: &mut SplitSink<WebSocket, Message>, message: Message) -> bool {
    let sent = tokio::time::timeout(SEND_MAX, sink.send(message)).await;
    matches!(sent, Ok(Ok(())))
}

fn close_frame(code: u16, sentence: &str) -> CloseFrame {
    /// Bytes of a reason in a close frame (RFC 6455, 5.5).
    const REASON_BYTES_MAX: usize = 123;
    let mut ends = (0..=REASON_BYTES_MAX.min(sentence.len())).rev();
    let end = ends
        .find(|end| sentence.is_char_boundary(*end))
        .unwrap_or(0);
    CloseFrame {
        code,
        reason: sentence[..end].into(),
    }
}
