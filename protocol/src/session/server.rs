//! The server's end of one client's session.

use crate::session::{LinkStats, PeerDatagram, PeerEvent, PeerMessage};
use crate::{ProtocolError, ServerTime, Span};

/// The server's end of one client's session.
pub struct ServerPeer {}

#[expect(unused_variables, reason = "bodies follow")]
impl ServerPeer {
    /// Waits for a client's preamble and hello.
    pub fn new(now: ServerTime) -> Self {
        Self {}
    }
    /// Bytes of the operations stream, in any pieces.
    pub fn handle_stream(&mut self, bytes: &[u8], now: ServerTime) {}
    /// One datagram.
    pub fn handle_datagram(&mut self, bytes: &[u8], now: ServerTime) {}
    /// Call when the time of `poll_timeout` has come.
    pub fn handle_timeout(&mut self, now: ServerTime) {}
    /// The connection under the session is gone.
    pub fn handle_disconnect(&mut self, why: String) {}
    /// Something reliable for the client.
    pub fn send(&mut self, message: &PeerMessage, now: ServerTime) -> Result<(), ProtocolError> {
        Ok(())
    }
    /// Something that may get lost.
    pub fn send_datagram(&mut self, datagram: &PeerDatagram, now: ServerTime) {}
    /// Bytes for the operations stream.
    pub fn poll_stream(&mut self) -> Option<Vec<u8>> {
        None
    }
    /// The next datagram.
    pub fn poll_datagram(&mut self, now: ServerTime) -> Option<Vec<u8>> {
        None
    }
    /// The next event.
    pub fn poll_event(&mut self) -> Option<PeerEvent> {
        None
    }
    /// When `handle_timeout` is due.
    pub fn poll_timeout(&self) -> Option<ServerTime> {
        None
    }
    /// How the connection does.
    pub fn stats(&self) -> LinkStats {
        LinkStats::default()
    }
}
