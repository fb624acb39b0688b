//! The state of the session as pages show it.

use std::collections::BTreeMap;

use palpate_protocol::{OperationId, ServerTime, Span};
use palpate_room::{PeerKey, Room, RoomConfig, SeatFigures};
use palpate_transport::PeerHandle;
use palpate_transport::threads::{CpuTime, cpu_time};
use palpate_view::{Board, Participant, State};

use super::pages::is_page;

/// Time between two states.
const PERIOD: Span = Span::from_millis(200);

/// Time from an operation to the next state, which may show several.
const SOON: Span = Span::from_millis(30);

/// Time between two measurements of the CPU use.
const CPU_PERIOD: Span = Span::from_millis(2000);

/// Collects the state several times per second, and after every operation.
pub(super) struct SessionView {
    board: Board,
    next: OperationId,
    due: ServerTime,
    cpu_began: CpuTime,
    cpu_due: ServerTime,
    cpu: BTreeMap<String, f64>,
}

impl SessionView {
    pub(super) fn new(config: &RoomConfig) -> Self {
        let seats = (config.seats, config.spectators);
        Self {
            board: Board::new(&config.compensation, Some(seats)),
            next: OperationId(0),
            due: ServerTime::ZERO,
            cpu_began: cpu_time(),
            cpu_due: ServerTime::ZERO + CPU_PERIOD,
            cpu: BTreeMap::new(),
        }
    }

    /// Takes the strokes that the session begins with: in effect, and taken back.
    pub(super) fn set_strokes(&mut self, strokes: [Vec<u64>; 2]) {
        self.board.set_strokes(strokes);
    }

    /// Follows the log. After an operation the next state is due soon.
    pub(super) fn follow(&mut self, room: &Room, now: ServerTime) {
        for operation in room.operations_since(self.next) {
            self.next = operation.id.next();
            self.board.apply(operation);
            self.due = self.due.min(now + SOON);
        }
    }

    /// The state, if it is due.
    pub(super) fn poll(
        &mut self,
        room: &Room,
        peers: &BTreeMap<PeerKey, PeerHandle>,
        now: ServerTime,
    ) -> Option<State> {
        if now < self.due {
            return None;
        }
        self.due = now + PERIOD;
        if now >= self.cpu_due {
            self.cpu_due = now + CPU_PERIOD;
            let newest = cpu_time();
            self.cpu = newest.usage_since(&self.cpu_began).classes;
            self.cpu_began = newest;
        }
        let mut state = self.board.state();
        let (version, hash) = room.topology();
        state.session.clock_s = now.as_micros() as f64 * 1e-6;
        state.session.delay_ms = room.delay_at(now).as_millis_f64();
        (state.session.topology_version, state.session.topology_hash) = (version, hash.to_string());
        state.session.cpu.clone_from(&self.cpu);
        for figures in room.seat_figures() {
            let mut seats = state.participants.iter_mut();
            if let Some(seat) = seats.find(|seat| seat.id == figures.id.0) {
                measure(seat, figures, peers);
            }
        }
        Some(state)
    }
}

fn measure(seat: &mut Participant, figures: SeatFigures, peers: &BTreeMap<PeerKey, PeerHandle>) {
    let handle = figures.peer.and_then(|peer| peers.get(&peer));
    let path = handle.map(|handle| handle.stats().path);
    seat.rtt_ms = path
        .map(|p| p.rtt.as_secs_f64() * 1e3)
        .or(figures.round_trip.map(Span::as_millis_f64));
    seat.loss = path.map(|p| p.lost_packets as f64 / p.sent_packets.max(1) as f64);
    seat.wanted_ms = figures.wanted_us.map(|us| f64::from(us) / 1e3);
    seat.is_page = figures.peer.is_some_and(is_page);
}
