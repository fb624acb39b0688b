//! The client's end of a session.

use crate::clock::ClockMap;
use crate::handshake::Hello;
use crate::request::RequestKind;
use crate::session::{ClientEvent, LinkStats};
use crate::{ClientTime, LocalSample, ParticipantId, ProtocolError, RequestId, Span};

/// The client's end of a session.
pub struct ClientSession {}

#[expect(unused_variables, reason = "bodies follow")]
impl ClientSession {
    /// Begins the handshake.
    pub fn new(hello: Hello, now: ClientTime) -> Result<Self, ProtocolError> {
        unimplemented!()
    }
    /// Bytes of the operations stream, in any pieces.
    pub fn handle_stream(&mut self, bytes: &[u8], now: ClientTime) {}
    /// One datagram.
    pub fn handle_datagram(&mut self, bytes: &[u8], now: ClientTime) {}
    /// Call when the time of `poll_timeout` has come.
    pub fn handle_timeout(&mut self, now: ClientTime) {}
    /// The connection under the session is gone.
    pub fn handle_disconnect(&mut self, why: String) {}
    /// Takes one sample of one's own tool (1 kHz).
    pub fn send_motion(&mut self, sample: LocalSample) {}
    /// Asks for something; the answer is an operation, or `RequestRefused`.
    pub fn request(&mut self, kind: RequestKind) -> Result<RequestId, ProtocolError> {
        unimplemented!()
    }
    /// Bytes for the operations stream.
    pub fn poll_stream(&mut self) -> Option<Vec<u8>> {
        None
    }
    /// The next datagram, made just in time.
    pub fn poll_datagram(&mut self, now: ClientTime) -> Option<Vec<u8>> {
        None
    }
    /// The next event.
    pub fn poll_event(&mut self) -> Option<ClientEvent> {
        None
    }
    /// When `handle_timeout` is due.
    pub fn poll_timeout(&self) -> Option<ClientTime> {
        None
    }
    /// From one's own clock to the server's, once locked.
    pub fn clock(&self) -> Option<ClockMap> {
        None
    }
    /// The artificial delay at a moment.
    pub fn delay_at(&self, t: crate::ServerTime) -> Span {
        Span::ZERO
    }
    /// One's own number, once welcomed.
    pub fn participant(&self) -> Option<ParticipantId> {
        None
    }
    /// How the connection does.
    pub fn stats(&self) -> LinkStats {
        LinkStats::default()
    }
}
