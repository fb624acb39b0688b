//! One WebSocket to the service.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use tungstenite::error::Error;
use tungstenite::handshake::HandshakeError;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, Utf8Bytes, WebSocket};

use super::silent;
use crate::OpenError;

/// Timeout of a connection attempt. The service runs on this machine, so a failure shows at once.
const CONNECT: Duration = Duration::from_millis(300);

/// Timeout of a reply or a send.
const PATIENCE: Duration = Duration::from_secs(1);

/// Maximum message size, bytes. An inventory of ten devices has 20,000; a larger message ends the connection.
const MESSAGE_MAX: usize = 256 * 1024;

/// The open connection.
pub(super) struct Link {
    socket: WebSocket<TcpStream>,
}

/// Result of a receive.
pub(super) enum Received {
    /// A text.
    Text(Utf8Bytes),
    /// Timeout. A text may still arrive.
    Nothing,
    /// A message that ends the connection: too large, or not a WebSocket message.
    Unfit(String),
    /// The service closed the connection.
    Closed(String),
}

impl Link {
    /// Connects.
    pub(super) fn open(url: &str) -> Result<Self, OpenError> {
        let stream = connect(url)?;
        let no_websocket = |why: String| {
            OpenError::new(format_args!(
                "the server at {url} is not a WebSocket server ({why}); is another program on that port?"
            ))
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
            Err(HandshakeError::Interrupted(_)) => Err(silent(url)),
        }
    }

    /// Sets the timeout of [`receive`](Self::receive).
    pub(super) fn wait_at_most(&self, wait: Duration) {
        // The system rejects only a timeout of zero.
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
                    Received::Closed("the service closed the connection".to_owned())
                }
                Ok(Message::Binary(_)) => {
                    Received::Unfit("the service sent a binary message instead of text".to_owned())
                }
                // The library answers pings.
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => continue,
                Err(Error::Io(why)) if is_late(why.kind()) => Received::Nothing,
                Err(Error::Io(why)) => Received::Closed(why.to_string()),
                Err(why) => Received::Unfit(why.to_string()),
            };
        }
    }

    /// Closes the connection.
    pub(super) fn close(mut self) {
        let _ = self.socket.close(None);
        let _ = self.socket.flush();
    }
}

fn is_late(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

fn connect(url: &str) -> Result<TcpStream, OpenError> {
    let bad = || {
        OpenError::new(format_args!(
            "invalid address of a Haply service: {url:?}; use a form like ws://localhost:10001"
        ))
    };
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
    Err(OpenError::new(format_args!(
        "no Haply service answers at {url} ({why}): install the Haply Hub or the Haply Inverse Service \
         from haply.co, and start it"
    )))
}
