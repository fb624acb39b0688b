//! A participant without tissue and without good manners: it sends any message at any time.

use std::time::Duration;

use palpate_protocol::codec::{FRAME_MAX_BYTES, FrameDecoder, encode_frame};
use palpate_protocol::datagram::{Body, Datagram, Header, Memory, Tag};
use palpate_protocol::handshake::{
    Hello, PREAMBLE_BYTES, Preamble, Refused, Resume, Subscription, Welcome,
};
use palpate_protocol::request::{ClientMessage, DelayReport, Request, RequestKind, ServerMessage};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{JoinLink, RequestId, ServerTime, Span};
use palpate_transport::{Connection, connect};
use tokio::time::{Instant, timeout, timeout_at};

/// Maximum time from the first packet to the welcome.
const JOIN_WITHIN: Duration = Duration::from_secs(10);

/// Maximum time that a write waits for the server's flow control.
const WRITE_WITHIN: Duration = Duration::from_secs(1);

/// Bytes read at once.
const PIECE: usize = 16 * 1024;

/// Failure to join.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(super) enum JoinError {
    /// The server refused the hello.
    #[error("{}", .0.sentence)]
    Refused(Refused),
    /// No connection, or no answer.
    #[error("{0}")]
    Failed(String),
}

/// A joined participant. Dropping it drops the connection without a farewell.
pub(super) struct RawClient {
    connection: Connection,
    decoder: FrameDecoder<ServerMessage>,
    pub(super) welcome: Welcome,
    welcomed: Instant,
    memory: Memory,
    sequence: u32,
    requests: u32,
}

/// A hello with the role and the grant of a link.
pub(super) fn hello(link: &JoinLink, name: String, tool: Option<ToolDescription>) -> Hello {
    Hello {
        name,
        role: link.role,
        grant: link.grant,
        tool,
        subscription: Subscription::Full,
        resume: None,
    }
}

impl RawClient {
    /// Connects, sends the hello and waits for the welcome.
    pub(super) async fn join(link: &JoinLink, hello: Hello) -> Result<Self, JoinError> {
        let failed = |e: String| JoinError::Failed(e);
        match timeout(JOIN_WITHIN, Self::shake_hands(link, hello)).await {
            Ok(joined) => joined,
            Err(_) => Err(failed(format!(
                "no welcome within {} s",
                JOIN_WITHIN.as_secs()
            ))),
        }
    }

    async fn shake_hands(link: &JoinLink, hello: Hello) -> Result<Self, JoinError> {
        let failed = |e: String| JoinError::Failed(e);
        let mut connection = connect(link).await.map_err(|e| failed(e.to_string()))?;
        let mut opening = Preamble::OURS.to_bytes().to_vec();
        let frame = encode_frame(&ClientMessage::Hello(hello));
        opening.extend(frame.map_err(|e| failed(e.to_string()))?);
        write(&mut connection, &opening).await.map_err(failed)?;
        let mut decoder = FrameDecoder::new(FRAME_MAX_BYTES);
        let mut preamble = Vec::new();
        loop {
            let bytes = read(&mut connection).await.map_err(failed)?;
            preamble.extend(bytes);
            let Some((first, rest)) = preamble.split_first_chunk::<PREAMBLE_BYTES>() else {
                continue;
            };
            let theirs = Preamble::from_bytes(*first).map_err(|e| failed(e.to_string()))?;
            if theirs.status != 0 {
                return Err(failed("the server refused the preamble".to_owned()));
            }
            decoder.push(rest);
            break;
        }
        loop {
            match decoder.next().map_err(|e| failed(e.to_string()))? {
                None => {}
                Some(ServerMessage::Welcome(welcome)) => {
                    return Ok(Self {
                        connection,
                        decoder,
                        welcome: *welcome,
                        welcomed: Instant::now(),
                        memory: Memory::default(),
                        sequence: 0,
                        requests: 0,
                    });
                }
                Some(ServerMessage::Refused(refused)) => return Err(JoinError::Refused(refused)),
                Some(ServerMessage::Goodbye { sentence }) => return Err(failed(sentence)),
                Some(_) => return Err(failed("a message before the welcome".to_owned())),
            }
            let bytes = read(&mut connection).await.map_err(failed)?;
            decoder.push(&bytes);
        }
    }

    /// The server's clock, up to the delay of the welcome.
    pub(super) fn server_now(&self) -> ServerTime {
        let since = i64::try_from(self.welcomed.elapsed().as_micros()).unwrap_or(i64::MAX);
        self.welcome.server_time + Span::from_micros(since)
    }

    /// The resumption of this seat with the whole log.
    pub(super) fn resume(&self) -> Resume {
        Resume::after_welcome(&self.welcome, None)
    }

    /// Sends a request.
    pub(super) async fn request(&mut self, kind: RequestKind) -> Result<(), String> {
        self.requests += 1;
        let id = RequestId(self.requests);
        let message = ClientMessage::Request(Request { id, kind });
        let frame = encode_frame(&message).map_err(|e| e.to_string())?;
        write(&mut self.connection, &frame).await
    }

    /// Sends a datagram; `false` if the transport's rate cap or buffer is exceeded.
    pub(super) fn send(&mut self, body: Body) -> bool {
        self.sequence += 1;
        let newest = match &body {
            // Motion has the time of its newest sample.
            Body::Motion(tracks) => tracks.first().and_then(|t| t.samples.last()),
            _ => None,
        };
        let generated = newest.map_or(self.server_now(), |sample| sample.time);
        let datagram = Datagram {
            header: Header {
                tag: Tag {
                    epoch: self.welcome.epoch,
                    stream: self.welcome.participant,
                },
                sequence: self.sequence,
                generated,
                // A receiver reads it without a baseline.
                is_whole: true,
                acknowledged: None,
            },
            body,
        };
        let bytes = datagram.encode(&mut self.memory);
        bytes.is_ok_and(|bytes| self.connection.send_datagram(bytes))
    }

    /// Sends bytes as a datagram, whatever they mean.
    pub(super) fn send_bytes(&mut self, bytes: Vec<u8>) -> bool {
        self.connection.send_datagram(bytes)
    }

    /// Reports a delay requirement.
    pub(super) fn report(&mut self, wanted: Duration) -> bool {
        let wanted_us = u32::try_from(wanted.as_micros()).unwrap_or(u32::MAX);
        let report = DelayReport {
            mean_us: wanted_us,
            deviation_us: 0,
            wanted_us,
        };
        self.send(Body::Delays(vec![(self.welcome.participant, report)]))
    }

    /// Prevents that the server considers this participant silent.
    pub(super) fn heartbeat(&mut self) -> bool {
        self.send(Body::Delays(Vec::new()))
    }

    /// The next message of the server, if one arrives until a time. An error is the end of the connection.
    pub(super) async fn next(&mut self, until: Instant) -> Result<Option<ServerMessage>, String> {
        loop {
            if let Some(message) = self.decoder.next().map_err(|e| e.to_string())? {
                return Ok(Some(message));
            }
            match timeout_at(until, read(&mut self.connection)).await {
                Ok(bytes) => self.decoder.push(&bytes?),
                Err(_) => return Ok(None),
            }
        }
    }

    /// Reads and discards messages for a while. An error is the end of the connection.
    pub(super) async fn drain(&mut self, wait: Duration) -> Result<(), String> {
        let until = Instant::now() + wait;
        while self.next(until).await?.is_some() {}
        Ok(())
    }

    /// Leaves, so that the seat is free at once.
    pub(super) async fn leave(mut self) {
        // A server that has ended needs no farewell.
        let _ = self.request(RequestKind::Leave).await;
        self.connection.close("left").await;
    }
}

/// Writes all bytes to the operations stream.
async fn write(connection: &mut Connection, mut bytes: &[u8]) -> Result<(), String> {
    while !bytes.is_empty() {
        match timeout(WRITE_WITHIN, connection.write(bytes)).await {
            Ok(written) => bytes = &bytes[written?..],
            Err(_) => return Err("the server does not read".to_owned()),
        }
    }
    Ok(())
}

/// Reads some bytes of the operations stream.
async fn read(connection: &mut Connection) -> Result<Vec<u8>, String> {
    let mut piece = vec![0; PIECE];
    match connection.read(&mut piece).await? {
        Some(n) => {
            piece.truncate(n);
            Ok(piece)
        }
        None => Err("the server ended the stream".to_owned()),
    }
}
