//! The network end of a simulated participant: its protocol session and its clock.

use palpate_protocol::handshake::Hello;
use palpate_protocol::session::{ClientEvent, ClientSession};

use super::links::{Arrived, Links};
use super::site_clock::SiteClock;
use crate::network::Direction;

/// A protocol session with the local clock of its participant. Times are true times in µs.
pub(crate) struct Endpoint {
    pub(crate) seat: usize,
    pub(crate) clock: SiteClock,
    pub(crate) session: ClientSession,
    /// Whether the connection stands; without it the session neither receives nor sends.
    pub(super) is_open: bool,
    /// First error.
    pub(crate) trouble: Option<String>,
}

impl Endpoint {
    pub(crate) fn new(seat: usize, hello: Hello, clock: SiteClock) -> Result<Self, String> {
        let session = ClientSession::new(hello, clock.at(0)).map_err(|e| e.to_string())?;
        Ok(Self {
            seat,
            clock,
            session,
            is_open: true,
            trouble: None,
        })
    }

    pub(super) fn handle(&mut self, arrived: &Arrived<Vec<u8>>, at_us: i64) {
        if !self.is_open {
            return;
        }
        let now = self.clock.at(at_us);
        match arrived {
            Arrived::Stream(segments) => self.session.handle_stream(&segments.concat(), now),
            Arrived::Datagram(bytes) => self.session.handle_datagram(bytes, now),
        }
    }

    pub(crate) fn handle_timeout(&mut self, at_us: i64) {
        let now = self.clock.at(at_us);
        if self.is_open && self.session.poll_timeout().is_some_and(|due| due <= now) {
            self.session.handle_timeout(now);
        }
    }

    pub(super) fn send(&mut self, links: &mut Links<Vec<u8>>, at_us: i64) {
        if !self.is_open {
            return;
        }
        while let Some(bytes) = self.session.poll_stream() {
            links.send_stream(self.seat, Direction::Up, at_us, &bytes);
        }
        while let Some(bytes) = self.session.poll_datagram(self.clock.at(at_us)) {
            links.send_datagram(self.seat, Direction::Up, at_us, bytes);
        }
    }

    /// Replaces the session by one over a new connection.
    pub(super) fn connect(&mut self, session: ClientSession) {
        (self.session, self.is_open) = (session, true);
    }

    pub(super) fn poll_event(&mut self) -> Option<ClientEvent> {
        self.is_open.then(|| self.session.poll_event()).flatten()
    }

    /// Keeps the first error.
    pub(crate) fn check<E: ToString>(&mut self, result: Result<(), E>) {
        if let Err(error) = result {
            self.trouble.get_or_insert(error.to_string());
        }
    }
}
