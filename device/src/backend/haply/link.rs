//! One WebSocket to the service.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use tungstenite::error::Error;
use tungstenite::handshake::HandshakeError;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, Utf8Bytes, WebSocket};

use super::HaplyError;

/// How long a connection is tried. The service is on this machine: where it is not, that is known at once.
const CONNECT: Duration = Duration::from_millis(300);

/// How long anything is waited for that the other side has to say or take.
const PATIENCE: Duration = Duration::from_secs(1);

/// The largest message that is taken, bytes. An inventory of ten devices has 20,000; a larger one closes the conversation.
const MESSAGE_MAX: usize = 256 * 1024;

/// The open conversation.
pub(super) struct Link {
    socket: WebSocket<TcpStream>,
}

/// What came.
pub(super) enum Received {
    /// A text.
    Text(Utf8Bytes),
    /// Nothing in time. It may still come.
    Nothing,
    /// Something that ends the conversation: too large, or no WebSocket.
    Unfit(String),
    /// The other side ended it.
    Closed(String),
}

impl Link {
    /// Connects.
    pub(super) fn open(url: &str) -> Result<Self, HaplyError> {
        let stream = connect(url)?;
        let no_websocket = |why: String| HaplyError::NoWebSocket {
            url: url.to_owned(),
            why,
        };
        let set = || {
            stream.set_nodelay(true)?;
            stream.set_read_timeout(Some(PATIENCE))?;
            stream.set_write_timeout(Some(PATIENCE))
        };
        set().map_err(|e| no_websocket(e.to_string()))?;
        let config = WebSocketConfig::default()
            .max_message_size(Some(MESSAGE_MAX))
            .max_frame_size(Some(MESSAGE_MAX));
        match tungstenite::client::client_with_config(url, stream, Some(config)) {
            Ok((socket, _)) => Ok(Self { socket }),
            Err(HandshakeError::Failure(why)) => Err(no_websocket(why.to_string())),
            Err(HandshakeError::Interrupted(_)) => Err(HaplyError::Silent {
                url: url.to_owned(),
            }),
        }
    }

    /// From now on, how long [`receive`](Self::receive) waits.
    pub(super) fn wait_at_most(&self, wait: Duration) {
        // The system refuses a time of zero, and no other.
        let _ = self.socket.get_ref().set_read_timeout(Some(wait));
    }

    /// Sends a text.
    pub(super) fn send(&mut self, text: String) -> Result<(), String> {
        let sent = self.socket.send(Message::Text(text.into()));
        sent.map_err(|why| why.to_string())
    }

    /// The next text.
    pub(super) fn receive(&mut self) -> Received {
        loop {
            return match self.socket.read() {
                Ok(Message::Text(text)) => Received::Text(text),
                Ok(Message::Close(_)) | Err(Error::ConnectionClosed | Error::AlreadyClosed) => {
                    Received::Closed("it ended the conversation".to_owned())
                }
                Ok(Message::Binary(_)) => {
                    Received::Unfit("it sends bytes instead of text".to_owned())
                }
                // Pings are answered by the library.
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => continue,
                Err(Error::Io(why)) if is_late(why.kind()) => Received::Nothing,
                Err(Error::Io(why)) => Received::Closed(why.to_string()),
                Err(why) => Received::Unfit(why.to_string()),
            };
        }
    }

    /// Says goodbye.
    pub(super) fn close(mut self) {
        let _ = self.socket.close(None);
        let _ = self.socket.flush();
    }
}

/// What systems say when nothing came in time.
fn is_late(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

fn connect(url: &str) -> Result<TcpStream, HaplyError> {
    let bad = || HaplyError::Address(url.to_owned());
    let rest = url.strip_prefix("ws://").ok_or_else(bad)?;
    let host = rest.split('/').next().unwrap_or(rest);
    let addresses: Vec<SocketAddr> = host.to_socket_addrs().map_err(|_| bad())?.collect();
    let mut why = "no such host".to_owned();
    for address in addresses {
        match TcpStream::connect_timeout(&address, CONNECT) {
            Ok(stream) => return Ok(stream),
            Err(e) => why = e.to_string(),
        }
    }
    Err(HaplyError::NotRunning {
        url: url.to_owned(),
        why,
    })
}
