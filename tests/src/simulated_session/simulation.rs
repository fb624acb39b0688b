//! Discrete-event simulation of a server and its participants.

use palpate_protocol::ServerTime;

use super::endpoint::Endpoint;
use super::host::Host;
use super::links::{Delivery, Links};
use crate::network::{Direction, Profile};

const STEP_US: i64 = 1000;

/// Retransmission timeout of a lost segment, µs: that of a transport with a round trip of 250 ms. The
/// receiver buffers later segments until then.
const RESEND_US: i64 = 300_000;

/// A participant of a simulation. Times are true times in µs.
pub(crate) trait Participant {
    fn endpoint(&mut self) -> &mut Endpoint;

    /// Starts a new connection if it needs one; returns whether it did.
    fn reconnect(&mut self, _at_us: i64) -> bool {
        false
    }

    fn take_events(&mut self, at_us: i64);

    /// Simulates one step. The simulation sends the output of the session.
    fn turn(&mut self, at_us: i64, host: &Host);
}

/// A server and its links in virtual time; the caller owns the participants, in the order of their seats.
pub(crate) struct Simulation {
    pub(crate) host: Host,
    pub(crate) links: Links<Vec<u8>>,
    pub(crate) at_us: i64,
}

impl Simulation {
    /// A simulation at time 0 with one network profile per seat.
    pub(crate) fn new(host: Host, profiles: &[&Profile], seed: u64) -> Self {
        Self {
            host,
            links: Links::new(profiles, seed, RESEND_US),
            at_us: 0,
        }
    }

    /// Delivers the packets that are due, each at its arrival time, and gives the server and every participant
    /// a turn.
    pub(crate) fn turn(&mut self, participants: &mut [&mut dyn Participant]) {
        let (at_us, now) = (self.at_us, ServerTime::from_micros(self.at_us));
        while let Some(delivery) = self.links.pop_due(at_us) {
            self.deliver(&delivery, participants);
        }
        self.host.turn(now, &mut self.links);
        for (seat, participant) in participants.iter_mut().enumerate() {
            if participant.reconnect(at_us) {
                self.links.renew(seat);
                self.host.renew(seat, now);
            }
            participant.turn(at_us, &self.host);
            participant.endpoint().send(&mut self.links, at_us);
        }
    }

    fn deliver(&mut self, delivery: &Delivery<Vec<u8>>, participants: &mut [&mut dyn Participant]) {
        let (seat, at_us) = (delivery.seat, delivery.at_us);
        match delivery.direction {
            Direction::Up => {
                let then = ServerTime::from_micros(at_us);
                self.host
                    .handle(seat, &delivery.arrived, then, &mut self.links);
            }
            Direction::Down => {
                let participant = &mut participants[seat];
                participant.endpoint().handle(&delivery.arrived, at_us);
                participant.take_events(at_us);
            }
        }
    }

    pub(crate) fn advance(&mut self) {
        self.at_us += STEP_US;
    }
}
