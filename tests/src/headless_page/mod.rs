//! A page without a browser: it joins a session over the WebSocket format of `client/view/WIRE.md`, and checks that shapes
//! arrive in sequence.

mod address;
mod sequence;

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

pub(crate) use address::PageAddress;
pub(crate) use sequence::{Arrived, Sequence};

/// The connection of a page.
pub(crate) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Maximum time from the connection to the welcome.
const JOIN_WITHIN: Duration = Duration::from_secs(10);

/// Time between two pings, as a page sends them.
const PING_EVERY: Duration = Duration::from_millis(500);

/// Failure of a page.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PageError {
    /// The host refused the page.
    #[error("{0}")]
    Refused(String),
    /// The connection.
    #[error("the connection of the page failed: {0}")]
    Socket(#[from] tungstenite::Error),
    /// The host closed the page.
    #[error("the host closed the page: {0}")]
    Closed(String),
    /// No welcome.
    #[error("no welcome within {} s", JOIN_WITHIN.as_secs())]
    Late,
}

/// A message of the host.
#[derive(Debug)]
pub(crate) enum Received {
    /// JSON.
    Text(Value),
    /// A binary message.
    Frame(Arrived),
}

/// A page that takes part. Dropping it drops the connection without a farewell.
pub(crate) struct HeadlessPage {
    socket: Socket,
    sequence: Sequence,
    pings: u32,
    ping_due: Instant,
}

impl HeadlessPage {
    /// Opens the connection without a hello; `origin` is that of a page from elsewhere.
    pub(crate) async fn open(
        address: &PageAddress,
        origin: Option<&'static str>,
    ) -> Result<Socket, PageError> {
        let mut request = address.session().into_client_request()?;
        if let Some(origin) = origin {
            let headers = request.headers_mut();
            headers.insert(
                "Origin",
                tungstenite::http::HeaderValue::from_static(origin),
            );
        }
        let connecting = timeout(JOIN_WITHIN, connect_async(request));
        let (socket, _) = connecting.await.map_err(|_| PageError::Late)??;
        Ok(socket)
    }

    /// Joins and waits for the welcome.
    pub(crate) async fn join(
        address: &PageAddress,
        name: &str,
        tool: Option<&Value>,
    ) -> Result<Self, PageError> {
        let mut socket = Self::open(address, None).await?;
        let hello = address.hello(name, tool);
        socket.send(Message::text(hello.to_string())).await?;
        let mut page = Self {
            socket,
            sequence: Sequence::default(),
            pings: 0,
            ping_due: Instant::now(),
        };
        timeout(JOIN_WITHIN, page.welcomed())
            .await
            .map_err(|_| PageError::Late)??;
        Ok(page)
    }

    async fn welcomed(&mut self) -> Result<(), PageError> {
        loop {
            if let Received::Text(text) = self.next().await? {
                let sentence = text["sentence"].as_str().unwrap_or_default();
                match text["type"].as_str() {
                    Some("welcome") => return Ok(()),
                    Some("refused") => return Err(PageError::Refused(sentence.to_owned())),
                    _ => {}
                }
            }
        }
    }

    /// The next message. Sends a ping twice a second meanwhile. Dropping the future loses no message.
    pub(crate) async fn next(&mut self) -> Result<Received, PageError> {
        loop {
            if Instant::now() >= self.ping_due {
                self.ping_due = Instant::now() + PING_EVERY;
                self.pings += 1;
                let ping = json!({"type": "ping", "id": self.pings, "sent_ms": wall_ms()});
                self.send(&ping).await?;
            }
            let wait = self.ping_due.saturating_duration_since(Instant::now());
            let Ok(message) = timeout(wait, self.socket.next()).await else {
                continue;
            };
            let Some(message) = message else {
                return Err(PageError::Closed("without a reason".to_owned()));
            };
            match message? {
                Message::Text(text) => {
                    let text = serde_json::from_str(&text).unwrap_or(Value::Null);
                    return Ok(Received::Text(text));
                }
                Message::Binary(bytes) => return Ok(Received::Frame(self.sequence.note(&bytes))),
                Message::Close(frame) => {
                    let reason = frame.map_or(String::new(), |f| f.reason.to_string());
                    return Err(PageError::Closed(reason));
                }
                _ => {}
            }
        }
    }

    /// Sends a text message.
    pub(crate) async fn send(&mut self, message: &Value) -> Result<(), PageError> {
        Ok(self.socket.send(Message::text(message.to_string())).await?)
    }

    /// The connection, for messages that no page sends.
    pub(crate) fn into_socket(self) -> Socket {
        self.socket
    }
}

/// Milliseconds since 1970, the clock of `made_ms` in shapes.
pub(crate) fn wall_ms() -> f64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0.0, |since| since.as_secs_f64() * 1e3)
}
