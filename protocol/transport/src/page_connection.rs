//! WebTransport over HTTP/3 on the endpoint of the sessions: the connection of a browser.
//!
//! ```text
//! PageDoor::accept -> PageAttempt --accept--> (PageSender, PageReceiver)   a stream, datagrams, and a stream per shape
//!                                 --refuse--> an HTTP status
//! ```
//!
//! The page opens one bidirectional stream in its session. All HTTP/3 that is needed for this fits here: one CONNECT
//! request per connection, no other requests, no dynamic header table.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use palpate_protocol::CertificateHash;
use quinn::{RecvStream, SendStream, VarInt};
use tokio::sync::{mpsc, oneshot};
use web_transport_proto::http::StatusCode;
use web_transport_proto::http::header::ORIGIN;
use web_transport_proto::{
    Capsule, ConnectRequest, ConnectResponse, Frame, Settings, StreamUni, VarInt as Number,
    error_to_http3,
};

use crate::certificate::ShortLived;
use crate::slots::Slot;

/// Bidirectional streams that a browser opens: the CONNECT request and the stream of the page.
const BROWSER_BI_STREAMS: u32 = 2;

/// The page's stream is sent before the shapes, so that a surface precedes its shapes.
const STREAM_PRIORITY: i32 = 1;

/// Bytes that are taken off the stream at once.
const CHUNK_BYTES: usize = 16 * 1024;

/// Wait for the acknowledgement of the last bytes before a close.
const FLUSH_MAX: Duration = Duration::from_secs(1);

/// The error code `H3_NO_ERROR` (RFC 9114, 8.1).
const NO_ERROR: u32 = 0x100;

/// The place where browsers arrive, beside the sessions of programs.
pub struct PageDoor {
    endpoint: PageEndpoint,
    attempts: mpsc::Receiver<PageAttempt>,
}

/// How a browser reaches the door.
#[derive(Debug, Clone)]
pub struct PageEndpoint {
    port: u16,
    certificate: Arc<ShortLived>,
}

impl PageDoor {
    pub(crate) fn new(
        port: u16,
        certificate: Arc<ShortLived>,
        attempts: mpsc::Receiver<PageAttempt>,
    ) -> Self {
        let endpoint = PageEndpoint { port, certificate };
        Self { endpoint, attempts }
    }

    /// How a browser reaches it.
    pub fn endpoint(&self) -> PageEndpoint {
        self.endpoint.clone()
    }

    /// The next browser; `None` once the server is gone. It is pending until [`PageSender::admit`]: it is closed
    /// without a complete hello 2 s after its handshake, or when newer connections need its place.
    pub async fn accept(&mut self) -> Option<PageAttempt> {
        self.attempts.recv().await
    }
}

impl PageEndpoint {
    /// The UDP port.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// SHA-256 of the present certificate; it changes once a week.
    pub fn certificate_hash(&self) -> CertificateHash {
        self.certificate.hash()
    }
}

/// The CONNECT request of a browser, not yet answered.
pub struct PageAttempt {
    http: Http,
    connect: RecvStream,
    request: ConnectRequest,
    slot: Slot,
}

/// The streams of HTTP/3. A browser ends the connection when one of them closes.
struct Http {
    quic: quinn::Connection,
    _control: (SendStream, RecvStream),
    connect: SendStream,
}

impl PageAttempt {
    /// Receives the request; `None` if what arrives is no WebTransport. The slot limits its time.
    pub(crate) async fn receive(quic: quinn::Connection, slot: Slot) -> Option<Self> {
        quic.set_max_concurrent_bi_streams(VarInt::from_u32(BROWSER_BI_STREAMS));
        let mut settings = Settings::default();
        settings.enable_webtransport(1);
        let mut control_send = quic.open_uni().await.ok()?;
        settings.write(&mut control_send).await.ok()?;
        let mut control_recv = quic.accept_uni().await.ok()?;
        let settings = Settings::read(&mut control_recv).await.ok()?;
        if settings.supports_webtransport() == 0 {
            return None;
        }
        let (connect_send, mut connect) = quic.accept_bi().await.ok()?;
        let request = ConnectRequest::read(&mut connect).await.ok()?;
        let http = Http {
            quic,
            _control: (control_send, control_recv),
            connect: connect_send,
        };
        Some(Self {
            http,
            connect,
            request,
            slot,
        })
    }

    /// The origin of the page; `None` of a program that is no browser.
    pub fn origin(&self) -> Option<String> {
        let origin = self.request.headers.get(ORIGIN)?;
        Some(String::from_utf8_lossy(origin.as_bytes()).into_owned())
    }

    /// Host name or address that the browser asked for, IPv6 in brackets, without the port.
    pub fn host(&self) -> &str {
        self.request.url.host_str().unwrap_or_default()
    }

    /// The path of the request.
    pub fn path(&self) -> &str {
        self.request.url.path()
    }

    /// Opens the session and waits for the page's stream; `None` if the browser is gone.
    pub async fn accept(mut self) -> Option<(PageSender, PageReceiver)> {
        let response = ConnectResponse::new(StatusCode::OK);
        response.write(&mut self.http.connect).await.ok()?;
        let session = u64::from(VarInt::from(self.http.connect.id()));
        let (send, mut recv) = self.http.quic.accept_bi().await.ok()?;
        let kind = Number::read(&mut recv).await.ok()?;
        let of = Number::read(&mut recv).await.ok()?;
        if Frame(kind) != Frame::WEBTRANSPORT || of.into_inner() != session {
            return None;
        }
        send.set_priority(STREAM_PRIORITY).ok()?;
        let receiver = PageReceiver {
            quic: self.http.quic.clone(),
            connect: self.connect,
            session: of,
            stream: recv,
        };
        let sender = PageSender {
            http: self.http,
            session: of,
            stream: send,
            slot: Some(self.slot),
        };
        Some((sender, receiver))
    }

    /// Refuses the session with an HTTP status, such as 403.
    pub async fn refuse(mut self, status: u16) {
        let status = StatusCode::from_u16(status).unwrap_or(StatusCode::FORBIDDEN);
        let response = ConnectResponse::new(status);
        if response.write(&mut self.http.connect).await.is_ok() {
            flush(&mut self.http.connect).await;
        }
    }
}

/// Bytes from a page.
pub enum PageBytes {
    /// The next bytes of its stream.
    Stream(Vec<u8>),
    /// A datagram.
    Datagram(Vec<u8>),
}

/// The half of a WebTransport session that receives.
pub struct PageReceiver {
    quic: quinn::Connection,
    connect: RecvStream,
    session: Number,
    stream: RecvStream,
}

impl PageReceiver {
    /// Receives bytes; `None` at the end of the session. No bytes are lost if the wait is given up.
    pub async fn receive(&mut self) -> Option<PageBytes> {
        loop {
            tokio::select! {
                // The last bytes of a stream precede the end of the session.
                biased;
                chunk = self.stream.read_chunk(CHUNK_BYTES, true) => {
                    return Some(PageBytes::Stream(chunk.ok()??.bytes.to_vec()));
                }
                datagram = self.quic.read_datagram() => {
                    let datagram = datagram.ok()?;
                    let mut rest = &datagram[..];
                    // A datagram begins with the session's number divided by four (RFC 9297, 2.1).
                    let is_own = Number::decode(&mut rest)
                        .is_ok_and(|of| of.into_inner() == self.session.into_inner() / 4);
                    if is_own {
                        return Some(PageBytes::Datagram(rest.to_vec()));
                    }
                }
                capsule = self.connect.read_chunk(CHUNK_BYTES, true) => {
                    // Only the end of this stream matters: it ends the session.
                    capsule.ok()??;
                }
            }
        }
    }

    /// The round trip time, smoothed.
    pub fn round_trip(&self) -> Duration {
        self.quic.rtt()
    }
}

/// The half of a WebTransport session that sends. Dropping it ends the connection.
pub struct PageSender {
    http: Http,
    session: Number,
    stream: SendStream,
    slot: Option<Slot>,
}

impl PageSender {
    /// Sends bytes on the page's stream. If the wait is given up, the stream is broken and must not be used again.
    pub async fn send(&mut self, bytes: &[u8]) -> bool {
        self.stream.write_all(bytes).await.is_ok()
    }

    /// The longest datagram in bytes; 0 if the browser takes none.
    pub fn datagram_max(&self) -> usize {
        let prefix = Number::MAX_SIZE;
        let max = self.http.quic.max_datagram_size().unwrap_or(0);
        max.saturating_sub(prefix)
    }

    /// Sends a datagram, or drops it if the buffer is full.
    pub fn send_datagram(&self, bytes: &[u8]) {
        let mut datagram = Vec::with_capacity(Number::MAX_SIZE + bytes.len());
        // The number of a session is a multiple of four, so the quotient fits.
        if let Ok(quarter) = Number::from_u64(self.session.into_inner() / 4) {
            quarter.encode(&mut datagram);
        }
        datagram.extend_from_slice(bytes);
        if self.http.quic.datagram_send_buffer_space() >= datagram.len() {
            // It may also be dropped on the way.
            let _ = self.http.quic.send_datagram(datagram.into());
        }
    }

    /// Sends bytes on a stream of their own, from a task of the present runtime.
    pub fn send_apart(&self, bytes: impl AsRef<[u8]> + Send + 'static) -> Delivery {
        let mut head = Vec::new();
        StreamUni::WEBTRANSPORT.encode(&mut head);
        self.session.encode(&mut head);
        let is_done = Arc::new(AtomicBool::new(false));
        let (reset, is_reset) = oneshot::channel();
        let quic = self.http.quic.clone();
        let done = Arc::clone(&is_done);
        tokio::spawn(async move {
            deliver(&quic, &head, bytes.as_ref(), is_reset).await;
            done.store(true, Ordering::Release);
        });
        Delivery { is_done, reset }
    }

    /// The round trip time, smoothed.
    pub fn round_trip(&self) -> Duration {
        self.http.quic.rtt()
    }

    /// The first message is complete; the session decides.
    pub fn handle_hello(&self) {
        if let Some(slot) = &self.slot {
            slot.handle_hello();
        }
    }

    /// The page takes part: the time of its connection is no longer limited, and it may send more at once.
    pub fn admit(&mut self) {
        if let Some(slot) = self.slot.take() {
            slot.admit();
        }
    }

    /// Ends the page's stream and waits at most one second until the sent bytes have arrived.
    pub async fn finish(&mut self) {
        flush(&mut self.stream).await;
    }

    /// Closes the session with a code and a sentence, which the browser hands to the page.
    pub async fn close(mut self, code: u32, sentence: &str) {
        let capsule = Capsule::CloseWebTransportSession {
            code,
            reason: sentence.to_owned(),
        };
        let mut content = Vec::new();
        capsule.encode(&mut content);
        let mut frame = Vec::new();
        Frame::DATA.encode(&mut frame);
        if let Ok(len) = Number::from_u64(content.len() as u64) {
            len.encode(&mut frame);
        }
        frame.extend_from_slice(&content);
        let connect = &mut self.http.connect;
        let written = tokio::time::timeout(FLUSH_MAX, connect.write_all(&frame)).await;
        if matches!(written, Ok(Ok(()))) {
            flush(connect).await;
        }
    }
}

impl Drop for Http {
    fn drop(&mut self) {
        self.quic.close(VarInt::from_u32(NO_ERROR), b"");
    }
}

/// Ends a stream and waits until its bytes have arrived.
async fn flush(stream: &mut SendStream) {
    if stream.finish().is_ok() {
        let _ = tokio::time::timeout(FLUSH_MAX, stream.stopped()).await;
    }
}

async fn deliver(
    quic: &quinn::Connection,
    head: &[u8],
    bytes: &[u8],
    mut is_reset: oneshot::Receiver<()>,
) {
    // A dropped handle is no reset: the shape may outlive the list that it was in.
    let reset = async {
        if (&mut is_reset).await.is_err() {
            std::future::pending::<()>().await;
        }
    };
    tokio::pin!(reset);
    let mut stream = tokio::select! {
        opened = quic.open_uni() => match opened {
            Ok(stream) => stream,
            Err(_) => return,
        },
        () = &mut reset => return,
    };
    let arrives = async {
        let written = async {
            stream.write_all(head).await?;
            stream.write_all(bytes).await
        };
        if written.await.is_ok() && stream.finish().is_ok() {
            let _ = stream.stopped().await;
        }
    };
    let is_stale = tokio::select! {
        () = arrives => false,
        () = &mut reset => true,
    };
    if is_stale && let Ok(code) = VarInt::from_u64(error_to_http3(0)) {
        // A stream that has arrived meanwhile needs no reset.
        let _ = stream.reset(code);
    }
}

/// Bytes under way on a stream of their own. Dropping it changes nothing.
pub struct Delivery {
    is_done: Arc<AtomicBool>,
    reset: oneshot::Sender<()>,
}

impl Delivery {
    /// Whether the bytes have arrived, or never will.
    pub fn is_done(&self) -> bool {
        self.is_done.load(Ordering::Acquire)
    }

    /// Gives the bytes up.
    pub fn reset(self) {
        // The task has ended when this fails.
        let _ = self.reset.send(());
    }
}

#[cfg(test)]
mod tests;
